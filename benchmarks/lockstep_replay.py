"""Is lockstep replay deterministic, and how fast is it? ``python -m benchmarks.lockstep_replay`` (under a minute).

One bag, ten replays in ten processes with different hash seeds: compositor with an attack file and a policy without a network. The bag
is made for it: a minute of images as the car's camera gives them (336 x 188, 10 Hz) and poses of car and board at 100 Hz, the
board in view all the time, so that every image has to be drawn on. ``--bag`` takes another one instead.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from advnerf_core.attack.artifact import (
    COLOURS,
    AttackedObject,
    AttackFace,
    AttackFile,
    face_texture,
    save_attack,
)
from advnerf_core.documents import dump_yaml
from advnerf_core.geometry import make_transform, planar_pose, rotation_z
from benchmarks.results import REPOSITORY, record_row
from calibration.schema import CameraCalibration, TargetCalibration, load_calibration
from nodes.bags.reader import read_info
from nodes.bags.writer import BagWriter
from nodes.replaying.nodes import Choice
from nodes.replaying.replay import Replay
from nodes.runtime.messages import encode, image_message, pose_message

COMMAND = "python -m benchmarks.lockstep_replay"
CALIBRATION = REPOSITORY / "calibration" / "twin"
START_NS = 1_800_000_000_000_000_000
MS = 1_000_000
REPLAYS, SPEED_TARGET = 10, 20.0
CHOICE = Choice(("compositor", "policy"), {"policy": "tests.support.live.straight_policy"})


def make_bag(folder: Path, seconds: int) -> Path:
    """Write the bag: the car goes around on a small circle in front of the board."""
    camera = load_calibration(CameraCalibration, CALIBRATION / "camera.yaml")
    target = load_calibration(TargetCalibration, CALIBRATION / "board.yaml")
    T_world_from_board = make_transform(rotation_z(np.pi), [3.0, 0.0, 0.5])
    theta = np.random.default_rng(0).normal(size=(8, 8, 3)).astype(np.float32)
    attack = AttackFile(
        method="gradient",
        space=COLOURS,
        objects=(AttackedObject("face", theta, T_world_from_board, 1.0, ""),),
        face=AttackFace(face_texture(theta, 256), (1.0, 1.0), "board", target.corners),
        camera=camera.pinhole,
        scene_sha256="",
        policy_sha256="",
        config_sha256="",
        seed=0,
        predicted_total_cte_m=1.0,
        software_version="0",
    )
    save_attack(folder / "face.attack.safetensors", attack)
    nodes = {
        "compositor": {
            "module": "nodes.compositor",
            "config": {"attack": "face.attack.safetensors", "camera": "camera.yaml", "target": "board.yaml"},
        },
        "policy": {"module": "nodes.policy", "config": {"policy": "none"}},
    }
    attachments = {
        "launch.resolved.yaml": dump_yaml({"name": "bench", "nodes": nodes}).encode(),
        "camera.yaml": (CALIBRATION / "camera.yaml").read_bytes(),
        "board.yaml": (CALIBRATION / "board.yaml").read_bytes(),
        "face.attack.safetensors": (folder / "face.attack.safetensors").read_bytes(),
    }
    with BagWriter(folder / "minute", attachments, attached_ns=START_NS) as writer:
        for tick in range(seconds * 100):
            _write_tick(writer, tick, T_world_from_board)
    return folder / "minute"


def _write_tick(writer: BagWriter, tick: int, T_world_from_board: np.ndarray) -> None:
    pose_ns = START_NS + tick * 10 * MS
    angle = 2.0 * np.pi * tick / 1000.0
    car = planar_pose(0.4 * np.cos(angle), 0.4 * np.sin(angle), 0.2 * np.sin(angle))
    for topic, T in (("/vicon/car", car), ("/vicon/board", T_world_from_board)):
        writer.write(topic, encode(pose_message(T, pose_ns)), pose_ns + 2 * MS, pose_ns + MS, tick)
    if tick % 10 == 3:
        rgb = np.random.default_rng(tick).integers(0, 255, (188, 336, 3), np.uint8)
        stamp_ns = pose_ns + 5 * MS
        image = encode(image_message(rgb, stamp_ns, "camera"))
        writer.write("/camera/image_raw", image, stamp_ns + 3 * MS, stamp_ns + 2 * MS, tick // 10)


def replay_once(bag: Path, choice: Choice) -> dict[str, object]:
    """Replay a bag in this process; from opening it to its end, without the import of Python modules."""
    with Replay(bag, choice):
        pass  # imports the nodes
    start, cpu_start = time.perf_counter(), time.process_time()
    with Replay(bag, choice) as replay:
        for _ in replay:
            pass
        wall_s, cpu_s = time.perf_counter() - start, time.process_time() - cpu_start
        summary = replay.summary
    torch_loaded = any(name == "torch" or name.startswith("torch.") for name in sys.modules)
    return {
        "digest": summary.digest,
        "speed": summary.duration_s / wall_s,
        "cpu_speed": summary.duration_s / cpu_s,
        "made": sum(summary.made.values()),
        "torch": torch_loaded,
    }


def replay_in_process(bag: Path, hash_seed: int) -> dict[str, object]:
    """The same in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.lockstep_replay", "--one", str(bag)]
    environment = {**os.environ, "PYTHONHASHSEED": str(hash_seed)}
    result = subprocess.run(
        command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=True
    )
    found: dict[str, object] = json.loads(result.stdout)
    return found


def measure(bag: Path, replays: int, record: bool) -> None:
    """Replay a bag again and again, print, and record the rows."""
    runs = []
    for seed in range(replays):
        runs.append(replay_in_process(bag, seed))
        run = runs[-1]
        speeds = f"{run['speed']:.1f} x real time, {run['cpu_speed']:.1f} x of processor time"
        print(f"{run['digest']}  {speeds}, torch loaded: {run['torch']}", flush=True)
    digests = {run["digest"] for run in runs}
    speed = statistics.median(float(str(run["speed"])) for run in runs)
    without_torch = not any(run["torch"] for run in runs)
    duration_s = read_info(bag).duration_s
    what = f"{duration_s:.0f} s, {runs[0]['made']} messages made by compositor and policy, each in its own process"
    if not record:
        print(f"{len(digests)} digest(s), median {speed:.1f} x real time (not recorded)")
        return
    record_row(
        "lockstep replay of one bag, 10 times",
        len(digests),
        "digest(s)",
        "one digest",
        len(digests) == 1,
        COMMAND,
        what,
    )
    record_row(
        "lockstep replay, speed without torch nodes",
        round(speed, 1),
        "x real time",
        f">= {SPEED_TARGET:g}",
        speed >= SPEED_TARGET and without_torch,
        COMMAND,
        f"median of {replays}; every image of {what} is drawn on",
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bag", type=Path, help="replay this bag, with the compositor alone")
    parser.add_argument(
        "--trial", action="store_true", help="ten seconds, three replays, nothing is recorded"
    )
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one is not None:
        own = "minute" in options.one.name
        print(json.dumps(replay_once(options.one, CHOICE if own else Choice(("compositor",)))))
        return
    replays = 3 if options.trial else REPLAYS
    if options.bag is not None:
        measure(options.bag, replays, record=False)
        return
    with tempfile.TemporaryDirectory(prefix="advnerf-") as folder:
        measure(make_bag(Path(folder), 10 if options.trial else 60), replays, record=not options.trial)


if __name__ == "__main__":
    main()
