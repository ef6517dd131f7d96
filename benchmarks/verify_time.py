"""How long does ``advnerf verify`` take on all published sets? ``python -m benchmarks.verify_time``."""

from __future__ import annotations

import argparse
import subprocess
import sys
import time

from advnerf_core.report.evidence.verifying.layout import sets_in
from benchmarks.results import REPOSITORY, record_row

_LIMIT_S = 60.0


def main() -> None:
    """Run the command and record the row."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    began = time.perf_counter()
    command = [sys.executable, "-m", "nodes.cli", "verify"]
    ended = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - began
    if ended.returncode:
        raise SystemExit(f"advnerf verify found problems: {ended.stderr.strip()}")
    sets = sets_in(REPOSITORY / "docs" / "results")
    note = f"{len(sets)} sets, their files and pictures, the history, the rows of kept data and the numbers on pages"
    print(f"{seconds:.1f} s")
    record_row("advnerf verify, everything that is published", seconds, "s", f"<= {_LIMIT_S:g} s", seconds <= _LIMIT_S, "python -m benchmarks.verify_time", note)  # fmt: skip


if __name__ == "__main__":
    main()
