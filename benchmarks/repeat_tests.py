"""Are tests green every time? ``python -m benchmarks.repeat_tests TEST ... --times 100 [--busy 4] [--cores 1]``.

``make test`` and ``make demo`` in place of tests repeat that target. Runs a selection of tests again and again, if asked beside endless loops of other sessions or on fewer cores, and counts the runs that
are green. What a red run printed is shown. Arguments after ``--`` are pytest's own, e.g. ``-- -m live``.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shlex
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator

from benchmarks.results import REPOSITORY, record_row

_LOOP = "while True: pass"
_AGAIN = "; again"
_MAKE_DEMO, _DEMO = ["make", "demo"], REPOSITORY / "runs" / "demo"


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """Endless loops, each in a session of its own, so that each has a whole share where sessions share the processors."""
    loops = [subprocess.Popen([sys.executable, "-c", _LOOP], start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def repeat(command: list[str], times: int) -> tuple[int, list[float], int, str]:
    """Run a command again and again.

    Returns:
        How often it succeeded, its times [s], how many tests were run again for want of time, and pytest's last summary.
    """
    green, seconds, again, summary = 0, [], 0, ""
    for number in range(1, times + 1):
        if command == _MAKE_DEMO and _DEMO.exists():
            shutil.rmtree(_DEMO)  # of the run before: a finished demo is only shown again
        began_s = time.monotonic()
        done = subprocess.run(
            command, cwd=REPOSITORY, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        seconds.append(time.monotonic() - began_s)
        again += done.stdout.count(_AGAIN)
        summary = "; ".join(re.findall(r"^\d+ passed[^\n]*(?= in )", done.stdout, re.M)) or summary
        green += done.returncode == 0
        print(
            f"{number:3d} {'green' if done.returncode == 0 else 'RED'} {seconds[-1]:.0f} s, {green} green",
            flush=True,
        )
        if done.returncode != 0:
            print(done.stdout, flush=True)
    return green, seconds, again, summary


def main() -> int:
    """Command line; 0 if every run was green."""
    given, _, extra = " ".join(map(shlex.quote, sys.argv[1:])).partition(" -- ")
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument(
        "tests", nargs="+", help="files or names of tests, as pytest takes them; or make and a target"
    )
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument(
        "--wanted", type=int, default=0, help="so many green runs are the target; 0: all of --times"
    )
    parser.add_argument("--busy", type=int, default=0, help="so many endless loops beside them")
    parser.add_argument("--cores", type=int, default=0, help="on so many cores; 0: all")
    parser.add_argument("--line", default="", help="what the tests show, as the row of results calls it")
    parser.add_argument("--trial", action="store_true", help="record nothing")
    options = parser.parse_args(shlex.split(given))
    if options.tests == _MAKE_DEMO and _DEMO.exists():
        parser.error(f"expected no {_DEMO}, as each run begins without one; move it away")
    cores = sorted(os.sched_getaffinity(0))[: options.cores or None]
    os.sched_setaffinity(0, cores)
    with busy(options.busy):
        pytest = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
        command = [*([] if options.tests[0] == "make" else pytest), *options.tests]
        green, seconds, again, summary = repeat([*command, *shlex.split(extra)], options.times)
    beside = (
        f", beside {options.busy} busy loops" * bool(options.busy)
        + f", on {len(cores)} cores" * bool(options.cores)
    ).replace("on 1 cores", "on one core")
    print(f"{green} of {options.times} green{beside}; {again} tests run again")
    wanted = options.wanted or options.times
    if not options.trial:
        record_row(
            f"{options.line or ' '.join([*options.tests, extra]).strip()}: green runs{beside}",
            green,
            f"of {options.times}",
            f"{wanted} of {wanted}",
            green == options.times >= wanted,
            f"python -m benchmarks.repeat_tests {' '.join(map(shlex.quote, sys.argv[1:]))}",
            f"{summary}{'; ' * bool(summary)}median {statistics.median(seconds):.0f} s, longest {max(seconds):.0f} s"
            + f"; {again} live tests were run again, as the processors had no time to spare" * bool(again),
        )
    return int(green != options.times)


if __name__ == "__main__":
    sys.exit(main())
