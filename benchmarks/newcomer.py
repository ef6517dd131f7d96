"""The newcomer's path, timed: clone, ``make demo``, ``make demo`` again. ``python -m benchmarks.newcomer`` (ten minutes)."""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.results import REPOSITORY, record_row

COMMAND = "python -m benchmarks.newcomer"
FIRST_LIMIT_S, AGAIN_LIMIT_S = 9 * 60, 90


def timed(command: list[str], folder: Path) -> float:
    """Seconds a command takes; a failure ends the benchmark with its output."""
    began = time.monotonic()
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    seconds = time.monotonic() - began
    print(done.stdout)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)} ended with {done.returncode} after {seconds:.0f} s")
    return seconds


def main() -> None:
    """Clone into a temporary folder and follow the README."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--folder", type=Path, help="where to clone to; kept (default: a temporary folder)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        clone = arguments.folder or Path(temporary) / "advnerf"
        began = time.monotonic()
        timed(["git", "clone", "--quiet", str(REPOSITORY), str(clone)], REPOSITORY)
        timed(["make", "demo"], clone)
        first_s = time.monotonic() - began
        again_s = timed(["make", "demo"], clone)
    record_row("clean clone to report", first_s / 60, "min", "<= 9 min", first_s <= FIRST_LIMIT_S, COMMAND)
    record_row("second run, nothing changed", again_s, "s", "<= 90 s", again_s <= AGAIN_LIMIT_S, COMMAND)
    print(f"clone to report {first_s / 60:.1f} min, again {again_s:.0f} s")


if __name__ == "__main__":
    main()
