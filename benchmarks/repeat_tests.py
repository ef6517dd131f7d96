"""Are tests green every time? ``python -m benchmarks.repeat_tests TEST ... --times 100 [--busy 4] [--cores 1]``.

``make test`` and ``make demo`` in place of tests repeat that target. Runs a selection of tests again and again, if asked beside endless loops of other sessions or on fewer cores, and counts the runs that
are green; the row of results is written after each run. What a red run printed is shown. Arguments after ``--`` are pytest's own, e.g. ``-- -m live``.
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
from dataclasses import dataclass, field

from benchmarks.results import REPOSITORY, read_rows, record_row

_AGAIN = "; again"
_MAKE_DEMO, _DEMO = ["make", "demo"], REPOSITORY / "runs" / "demo"


def endless_loop() -> tuple[str, ...]:
    """Arguments of a Python that computes until this process ends, also if it is killed."""
    return "-c", f"import os\nwhile os.getppid() == {os.getpid()}: pass"


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """Endless loops, each in a session of its own, so that each has a whole share where sessions share the processors."""
    command = [sys.executable, *endless_loop()]
    loops = [subprocess.Popen(command, start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


@dataclass
class Runs:
    """Runs of one command.

    Attributes:
        green: How many succeeded.
        seconds: Their times [s].
        again: How many tests were run again for want of time.
        summary: Pytest's last one.
    """

    green: int = 0
    seconds: list[float] = field(default_factory=list)
    again: int = 0
    summary: str = ""

    def add(self, command: list[str]) -> None:
        """Run the command once more, and print whether it was green; of a red run all that it printed."""
        if command == _MAKE_DEMO and _DEMO.exists():
            shutil.rmtree(_DEMO)  # of the run before: a finished demo is only shown again
        began_s = time.monotonic()
        done = subprocess.run(
            command, cwd=REPOSITORY, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        self.seconds.append(time.monotonic() - began_s)
        self.again += done.stdout.count(_AGAIN)
        self.summary = "; ".join(re.findall(r"^\d+ passed[^\n]*(?= in )", done.stdout, re.M)) or self.summary
        self.green += done.returncode == 0
        word = "green" if done.returncode == 0 else "RED"
        print(f"{len(self.seconds):3d} {word} {self.seconds[-1]:.0f} s, {self.green} green", flush=True)
        if done.returncode != 0:
            print(done.stdout, flush=True)

    def record(self, line: str, before: tuple[int, int], wanted: int) -> None:
        """Write the row, with the green runs and all runs that were counted before."""
        green, count = before[0] + self.green, before[1] + len(self.seconds)
        record_row(
            line,
            green,
            f"of {count}",
            f"{wanted} of {wanted}",
            green == count >= wanted,
            f"python -m benchmarks.repeat_tests {' '.join(map(shlex.quote, sys.argv[1:]))}",
            f"{self.summary}{'; ' * bool(self.summary)}median {statistics.median(self.seconds):.0f} s, longest {max(self.seconds):.0f} s"
            + f"; {before[1]} of the runs were made before, on other commits" * bool(before[1])
            + f"; {self.again} live tests were run again, as the processors had no time to spare"
            * bool(self.again),
        )


def _counted(line: str) -> tuple[int, int]:
    """Green runs, and runs, that the row of results counts."""
    found = next((row for row in read_rows() if row["line"] == line), None)
    return (0, 0) if found is None else (int(found["value"]), int(found["unit"].removeprefix("of ")))


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
    parser.add_argument(
        "--add", action="store_true", help="add these runs to those that the row of results counts already"
    )
    options = parser.parse_args(shlex.split(given))
    if options.tests == _MAKE_DEMO and _DEMO.exists():
        parser.error(f"expected no {_DEMO}, as each run begins without one; move it away")
    cores = sorted(os.sched_getaffinity(0))[: options.cores or None]
    os.sched_setaffinity(0, cores)
    beside = (
        f", beside {options.busy} busy loops" * bool(options.busy)
        + f", on {len(cores)} cores" * bool(options.cores)
    ).replace("on 1 cores", "on one core")
    line = f"{options.line or ' '.join([*options.tests, extra]).strip()}: green runs{beside}"
    before, runs = _counted(line) if options.add else (0, 0), Runs()
    pytest = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    command = [*([] if options.tests[0] == "make" else pytest), *options.tests, *shlex.split(extra)]
    with busy(options.busy):
        for _ in range(options.times):
            runs.add(command)
            if not options.trial:
                runs.record(line, before, options.wanted or before[1] + options.times)
    print(f"{runs.green} of {options.times} green{beside}; {runs.again} tests run again")
    return int(runs.green != options.times)


if __name__ == "__main__":
    sys.exit(main())
