"""``advnerf audit`` of policies that other people's programs trained, in worlds that can be driven: ``python -m benchmarks.foreign_audit WORLD [--by torch|keras]``.

The world is driven off its path by hand, so to say: pictures from poses beside it with the steering that leads back. A program that imports nothing
of this project learns from them and writes an ONNX file, which is audited as it is. ``--python`` names another interpreter for the training.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from advnerf_core.attack.pose_maps import starts_beside
from advnerf_core.documents import Document
from advnerf_core.geometry import invert_transform, planar_pose
from advnerf_core.policies.tracker import TrackedTrajectory
from benchmarks.own_place import run_audit
from benchmarks.results import record_row
from hardware.worlds.world import World, WorldDescription
from nodes.audit.places import AuditedWorld
from nodes.lab.worlds.expert_drive import as_path
from nodes.lab.worlds.named import read_world

PICTURES, WIDTH_PX, HEIGHT_PX = 1200, 96, 54
# The driver who is copied looks so far ahead [s], and the pictures are taken within this of the path: of half a lane, and of a turn [rad].
_AHEAD_S, _BESIDE, _TURNED_RAD = 1.0, 0.3, 0.12
_SEED, _STARTS = 7, 50


def poses(
    described: WorldDescription, name: str, rng: np.random.Generator
) -> Iterator[tuple[tuple[float, float, float], float]]:
    """Poses of the car beside a path, with the control that leads back to it: pure pursuit (Coulter 1992)."""
    path, car = as_path(described.paths[name]), described.car
    ahead_m = _AHEAD_S * car.speed_mps
    of_car = {"car_speed_mps": car.speed_mps} if car.wheelbase_m is None else {"wheelbase_m": car.wheelbase_m}
    pursuit = TrackedTrajectory(times_s=(_AHEAD_S,), lookahead_m=ahead_m, **of_car)
    end_m = path.length_m if path.closed else path.length_m - ahead_m
    for along_m in rng.uniform(0.0, end_m, PICTURES).tolist():
        beside_m, turn_rad = rng.normal(0.0, (_BESIDE * described.off_track_m, _TURNED_RAD)).tolist()
        (pose,) = starts_beside(np.asarray(path.pose_at(along_m)).tolist(), [beside_m], [turn_rad])
        x_m, y_m, _ = np.asarray(path.pose_at(along_m + ahead_m)).tolist()
        target = invert_transform(planar_pose(*pose)) @ [x_m, y_m, 0.0, 1.0]
        yield pose, float(pursuit.control(target[None, None, :2])[0])


def record(world: World, name: str, file: Path) -> None:
    """Write small pictures and steering in -1..1, left positive."""
    described, images, steering = world.describe(), [], []
    for pose, control in poses(described, name, np.random.default_rng(_SEED)):
        rgb = world.observe_at(*pose, depth=False)[0]
        images.append(cv2.resize(rgb, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA))
        steering.append(np.clip(control / described.car.largest_control, -1.0, 1.0))
    np.savez(file, images=np.stack(images), steering=np.array(steering))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("world", help="metadrive, duckietown, lab or file.py:Class")
    parser.add_argument("--by", choices=("torch", "keras"), default="torch")
    parser.add_argument("--python", default=sys.executable, help="interpreter that trains, which has Keras")
    parser.add_argument("--budget", default="15m")
    parser.add_argument("--starts", type=int, default=_STARTS)
    parser.add_argument("--set", action="append", default=[], help="handed on to the audit")
    parser.add_argument("--output", type=Path, help="keep the audit here")
    options = parser.parse_args()
    file, _, name = options.world.rpartition(":")
    named = f"{Path(file).resolve()}:{name}" if file else name
    with tempfile.TemporaryDirectory() as made:
        folder = options.output or Path(made)
        folder.mkdir(parents=True, exist_ok=True)
        place = AuditedWorld(named).place(None)
        with read_world(Document(dict(place.world), named), Path.cwd()).make() as world:
            record(world, place.path or next(iter(world.describe().paths)), folder / "data.npz")
        script = Path(__file__).parent / "strangers_victims" / f"train_{options.by}.py"
        subprocess.run([options.python, script, "data.npz", "policy.onnx"], cwd=folder, check=True)
        words = ["policy.onnx", "--world", named, "--limit", "off-lane", "--budget", options.budget]
        words += [
            "--starts",
            str(options.starts),
            *(word for each in options.set for word in ("--set", each)),
        ]
        result, minutes = run_audit(folder, "audit", *words)
    driven = "nothing was driven" if result.judgement is None else (
        f"{result.judgement.off_track} of {len(result.judgement.starts)} fresh starts off the lane ({result.judgement.evidence})"
    )  # fmt: skip
    record_row(
        f"audit of a policy that plain {options.by} trained, in {name}: verdict",
        result.verdict.outcome, "", "a verdict", result.verdict.outcome in ("found", "nothing_found"),
        f"python -m benchmarks.foreign_audit {options.world} --by {options.by} --budget {options.budget}"
        + f" --starts {options.starts}" * (options.starts != _STARTS) + "".join(f" --set {each}" for each in options.set), f"{result.verdict.sentence} {driven}; {minutes:.1f} min",
    )  # fmt: skip


if __name__ == "__main__":
    main()
