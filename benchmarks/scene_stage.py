"""What does the demo's learned scene cost? ``python -m benchmarks.scene_stage --before FOLDER``: stages scene and bake, against other code.

``FOLDER`` is another checkout, for example ``git worktree add ../before af4e442``. Both take the same photographs of the simulated room
with their own demo setting, in turns, each in a process of its own. User time counts, which other processes change little; the smallest
of each, as kernels are compiled in the first turn.
"""

from __future__ import annotations

import argparse
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
    parser.add_argument("--turns", type=int, default=2)
    parser.add_argument("--dry-run", action="store_true", help="print, but record nothing")
    arguments = parser.parse_args()
    found: dict[str, list[Build]] = {}
    with tempfile.TemporaryDirectory() as name:
        codes = {"before": arguments.before.resolve(), "now": REPOSITORY}
        for way, code in codes.items():
            _run(code, Path(name, f"{way}_photographs"), "capture")
        for _ in range(arguments.turns):
            for way, code in codes.items():
                photographs = Path(name, f"{way}_photographs")
                found.setdefault(way, []).append(_build(code, photographs, Path(name, way)))
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


def _build(code: Path, photographs: Path, folder: Path) -> Build:
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(photographs, folder)
    counts, before_s = folder / "counts.json", resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    _run(code, folder, "bake", counts)
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
        **read_json(counts),
    )
    print(f"{code.name}: {build}", flush=True)
    return build


def _run(code: Path, folder: Path, until: str, counts: Path | None = None) -> None:
    """Run the demo up to a stage with the code of a checkout."""
    environment = {**os.environ, "PYTHONPATH": _path(code), "COUNTS": str(counts or os.devnull)}
    # The command's names before they were put into groups.
    is_old = not (code / "nodes" / "experiment" / "show").exists()
    command = ["experiment", *([] if is_old else ["run"]), str(code / _LAUNCH), "--setting", "demo"]
    command += ["--run-folder" if is_old else "--folder", str(folder)]
    subprocess.run(
        [sys.executable, "-c", _COUNTING, *command, "--until", until],
        cwd=folder.parent,
        env=environment,
        check=True,
        stdout=subprocess.DEVNULL,
    )


def _path(code: Path) -> str:
    """Where modules are looked for; what only the other code depends on may stand in the caller's own path."""
    return os.pathsep.join([str(code), *filter(None, [os.environ.get("PYTHONPATH")])])


if __name__ == "__main__":
    main()
