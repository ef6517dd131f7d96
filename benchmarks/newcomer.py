"""The newcomer's path, timed: clone, ``make demo``, ``make demo`` again. ``python -m benchmarks.newcomer`` (ten minutes).

``--tests`` times ``make test`` in a clone that is set up, instead; with ``--folder`` of an earlier run, the second time.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.results import REPOSITORY, record_row

COMMAND = "python -m benchmarks.newcomer"
FIRST_LIMIT_S, AGAIN_LIMIT_S, TESTS_LIMIT_S = 9 * 60, 90, 5 * 60


def timed(command: list[str], folder: Path) -> float:
    """Seconds a command takes; a failure ends the benchmark with its output."""
    began = time.monotonic()
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    seconds = time.monotonic() - began
    print(done.stdout)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)} ended with {done.returncode} after {seconds:.0f} s")
    return seconds


def cloned(folder: Path) -> None:
    """A clone of this repository's commits; one that is there already is left as it is."""
    if not folder.exists():
        timed(["git", "clone", "--quiet", str(REPOSITORY), str(folder)], REPOSITORY)


def tests(clone: Path) -> None:
    """Time the default tests where everything is installed; their first run compiles the kernels."""
    cloned(clone)
    timed(["make", "setup"], clone)
    is_first = not (clone / ".venv" / ".kernels").exists()
    before = os.times()
    tests_s = timed(["make", "test"], clone)
    used = os.times()
    core_s = used.children_user + used.children_system - before.children_user - before.children_system
    record_row(
        "make test, set up before" if is_first else "make test, kernels compiled before",
        tests_s / 60,
        "min",
        "<= 5 min",
        tests_s <= TESTS_LIMIT_S,
        f"{COMMAND} --tests",
        f"{core_s:.0f} core-seconds; two cores give 600 in five minutes",
    )


def demo(clone: Path) -> None:
    """Follow the README into a new folder, twice."""
    began = time.monotonic()
    cloned(clone)
    timed(["make", "demo"], clone)
    first_s = time.monotonic() - began
    again_s = timed(["make", "demo"], clone)
    record_row("clean clone to report", first_s / 60, "min", "<= 9 min", first_s <= FIRST_LIMIT_S, COMMAND)
    record_row("second run, nothing changed", again_s, "s", "<= 90 s", again_s <= AGAIN_LIMIT_S, COMMAND)
    print(f"clone to report {first_s / 60:.1f} min, again {again_s:.0f} s")


def main() -> None:
    """Clone into a temporary folder and follow the README."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--folder", type=Path, help="where to clone to; kept (default: a temporary folder)")
    parser.add_argument("--tests", action="store_true", help="time make test instead; the clone may be there")
    arguments = parser.parse_args()
    if arguments.folder and arguments.folder.exists() and not arguments.tests:
        parser.error(
            f"expected a folder that is not there yet, got {arguments.folder}: a newcomer has no environment"
        )
    with tempfile.TemporaryDirectory() as temporary:
        (tests if arguments.tests else demo)(arguments.folder or Path(temporary) / "advnerf")


if __name__ == "__main__":
    main()
