"""``make bench``: every benchmark that needs no other data and less than a few minutes, one after the other."""

from __future__ import annotations

import subprocess
import sys
import time

from benchmarks.results import REPOSITORY

MODULES = (
    "benchmarks.hash_encoding",
    "benchmarks.adjoint_gradient",
    "benchmarks.adjoint_memory",
    "benchmarks.fault_stops",
)


def main() -> int:
    """Run them all; the exit code is 1 if one failed."""
    failed = []
    for module in MODULES:
        began = time.monotonic()
        code = subprocess.run([sys.executable, "-m", module], cwd=REPOSITORY).returncode
        print(
            f"{module}: {'done' if code == 0 else f'failed with {code}'} in {time.monotonic() - began:.0f} s",
            flush=True,
        )
        if code != 0:
            failed.append(module)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
