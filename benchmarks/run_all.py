"""``make bench``: every benchmark that needs no other data, one after the other.

Those that look at a learned scene use the run folder of ``make experiment`` and are left out without one; ``--quick`` leaves out
those that take more than a few minutes. ``make campaign`` (``--campaign``) is the live stack's turn instead: faults, strangers, killed
recorders, half an hour of driving. They take hours together, and go on where they were stopped.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.results import REPOSITORY

QUICK = (
    "hash_encoding", "adjoint_gradient", "adjoint_memory", "fault_stops", "hydrant", "structure_from_motion", "few_photographs",
    "training_step", "coverage", "floors",
)  # fmt: skip
LONG = ("attack_kill", "scene_kill", "adjoint_memory --compare", "newcomer")
CAMPAIGN = (
    "one_hop", "frame_age", "car_nodes", "launch_times", "calibrations", "lockstep_replay", "strangers", "ros2_strangers", "two_hosts", "bag_kill", "bag_kill --splits",
    "requests", "fuzz", "page_strangers", "page_latency", "page_faults", "stops", "pose_jumps", "stalls", "policy_from_bags", "fault_campaign", "thirty_minutes",
    "world_faults",
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
    parser.add_argument("--campaign", action="store_true", help="what the live stack must bear, instead")
    parser.add_argument("--quick", action="store_true", help="leave out what takes more than a few minutes")
    options = parser.parse_args()
    failed = []
    for command in CAMPAIGN if options.campaign else commands(options.folder, options.quick):
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
