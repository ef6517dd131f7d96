"""``make bench``: every benchmark that needs no other data, one after the other.

Those that look at a learned scene use the run folder of ``make experiment`` and are left out without one; ``--quick`` leaves out
those that take more than a few minutes. ``make bench-live`` (``--live``) measures the live stack instead.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.results import REPOSITORY

QUICK = (
    "hash_encoding", "adjoint_gradient", "adjoint_memory", "hydrant", "structure_from_motion", "few_photographs",
    "training_step", "coverage", "floors",
)  # fmt: skip
LONG = ("adjoint_memory --compare", "newcomer")
LIVE = (
    "one_hop", "frame_age", "car_nodes", "launch_times", "calibrations", "lockstep_replay", "two_hosts", "page_latency",
    "policy_from_bags",
)  # fmt: skip
OF_A_RUN = ("baked_scene", "gradient_pass", "objects", "phone_to_car", "closed_loop_cosine")


def commands(run_folder: Path, quick: bool) -> list[str]:
    """What to run, as arguments after ``python -m benchmarks.``."""
    chosen = [*QUICK, *(() if quick else LONG)]
    if (run_folder / "policy" / "policy.safetensors").exists():
        chosen += [f"{name} {run_folder}" for name in OF_A_RUN]
    else:
        print(f"left out without {run_folder}: {', '.join(OF_A_RUN)}; make experiment leaves it", flush=True)
    return chosen


def main() -> int:
    """Run them all; the exit code is 1 if one failed."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--folder", type=Path, default=Path("runs/full"))
    parser.add_argument("--live", action="store_true", help="those of the live stack instead")
    parser.add_argument("--quick", action="store_true", help="leave out what takes more than a few minutes")
    options = parser.parse_args()
    failed = []
    for command in LIVE if options.live else commands(options.folder, options.quick):
        began = time.monotonic()
        module, *arguments = command.split()
        code = subprocess.run(
            [sys.executable, "-m", f"benchmarks.{module}", *arguments], cwd=REPOSITORY
        ).returncode
        outcome = "done" if code == 0 else f"failed with {code}"
        print(f"{command}: {outcome} in {time.monotonic() - began:.0f} s", flush=True)
        if code != 0:
            failed.append(command)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
