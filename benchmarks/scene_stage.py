"""What does the demo's learned scene cost? ``python -m benchmarks.scene_stage --before FOLDER``: stages scene and bake, against other code.

``FOLDER`` is another checkout, for example ``git worktree add ../before af4e442``. Both take the same photographs of the simulated room
with their own demo setting, in turns, each in a process of its own whose kernels are compiled already. User time counts, which
other processes change little; the smallest of each.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from advnerf_core.documents import read_json
from benchmarks.results import REPOSITORY, record_row

MOST_RATIO, MOST_LOST_DB = 0.5, 0.1
_LAUNCH = Path("launch", "room.experiment.yaml")
# Runs the command line in a process that also counts rays and samples.
_COUNTING = """
import atexit, json, os, sys
from advnerf_core.scene.train_step import CpuStep
plain, counts = CpuStep.step, {"rays": 0, "samples": 0}
def step(self, rays, targets, samples, *others):
    counts["rays"] += len(rays)
    counts["samples"] += len(samples.points)
    return plain(self, rays, targets, samples, *others)
CpuStep.step = step
atexit.register(lambda: open(os.environ["COUNTS"], "w").write(json.dumps(counts)))
from nodes.cli.main import main
sys.exit(main())
"""


@dataclass(frozen=True)
class Build:
    """Cost and quality of a learned scene.

    Attributes:
        user_s: User time of the stages [s].
        full_db: Held-out PSNR at the camera's size [dB].
        policy_db: Held-out PSNR in the policy's view [dB].
        baked_db: The same of the baked scene [dB].
        rays: Rays that it was trained on.
        samples: Samples on them.
    """

    user_s: float
    full_db: float
    policy_db: float
    baked_db: float
    rays: int
    samples: int

    def __str__(self) -> str:
        return (
            f"{self.user_s:.0f} s, {self.full_db:.2f} dB at the camera's size, {self.policy_db:.2f} dB in the policy's view, "
            f"{self.baked_db:.2f} dB baked, {self.rays / 1e6:.2f} M rays, {self.samples / 1e6:.1f} M samples"
        )


def main() -> None:
    """Build in turns, compare and record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--before", type=Path, required=True, help="checkout of the code to compare with")
    parser.add_argument("--commit", required=True, help="its commit, for the row")
    parser.add_argument("--turns", type=int, default=1)
    parser.add_argument("--dry-run", action="store_true", help="print, but record nothing")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        photographs, found = Path(name, "photographs"), {}
        _run(REPOSITORY, photographs, "capture")
        for way, code in (("before", arguments.before.resolve()), ("now", REPOSITORY)):
            _build(code, photographs, Path(name, "compile"), "--set", "scene.steps=2")
            found[way] = [_build(code, photographs, Path(name, way))]
        for _ in range(arguments.turns - 1):
            found["before"].append(_build(arguments.before.resolve(), photographs, Path(name, "before")))
            found["now"].append(_build(REPOSITORY, photographs, Path(name, "now")))
    before, now = (min(found[way], key=lambda build: build.user_s) for way in ("before", "now"))
    ratio, lost_db = now.user_s / before.user_s, before.full_db - now.full_db
    note = f"now {now}; {arguments.commit} {before}; shortest of {arguments.turns} in turns"
    print(f"{ratio:.2f} x: {note}")
    if not arguments.dry_run:
        command = f"python -m benchmarks.scene_stage --before FOLDER --commit {arguments.commit}"
        line = "demo, learning and baking the room: user time against"
        record_row(f"{line} {arguments.commit}", ratio, "x", "<= 0.5 x", ratio <= MOST_RATIO, command, note)
        record_row(
            f"demo, learning the room: held-out PSNR lost against {arguments.commit}",
            lost_db,
            "dB",
            f"<= {MOST_LOST_DB} dB",
            lost_db <= MOST_LOST_DB,
            command,
            note,
        )


def _build(code: Path, photographs: Path, folder: Path, *settings: str) -> Build:
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(photographs, folder)
    counts, before_s = folder / "counts.json", resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    _run(code, folder, "bake", *settings, counts=counts)
    user_s = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before_s
    mean, baked = (
        read_json(folder / "scene" / "fidelity.json")["mean"],
        read_json(folder / "bake" / "baked.json"),
    )
    build = Build(
        user_s,
        mean["psnr_full_db"],
        mean["psnr_policy_db"],
        baked.get("psnr_baked_db", float("nan")),
        **json.loads(counts.read_text()),
    )
    print(f"{code.name}: {build}", flush=True)
    return build


def _run(code: Path, folder: Path, until: str, *settings: str, counts: Path | None = None) -> None:
    """Run the demo up to a stage with the code of a checkout."""
    environment = {**os.environ, "PYTHONPATH": str(code), "COUNTS": str(counts or os.devnull)}
    command = ["experiment", "run", str(code / _LAUNCH), "--setting", "demo", "--folder", str(folder)]
    subprocess.run(
        [sys.executable, "-c", _COUNTING, *command, "--until", until, *settings],
        cwd=folder.parent,
        env=environment,
        check=True,
        stdout=subprocess.DEVNULL,
    )


if __name__ == "__main__":
    main()
