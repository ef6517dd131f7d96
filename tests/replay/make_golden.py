"""Makes the little bag of these tests and its golden bag again, byte for byte: ``python tests/replay/make_golden.py [FOLDER]``.

A car drives straight at the board at 0.8 m/s: 48 x 27 images at 10 Hz, poses at 50 Hz. Everything in it is made of whole numbers
and exact binary fractions, so that every machine writes the same bytes.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import yaml

from advnerf_core.attack.artifact import save_attack
from advnerf_core.geometry import Pinhole
from nodes.bags.writer import BagWriter
from nodes.runtime.messages import encode, image_message, pose_message
from tests.support.faces import face_attack

HERE = Path(__file__).parent
BAG_NAME, GOLDEN_NAME = "corner.mcap", "corner.golden.mcap"
START_NS = 1_800_000_000_000_000_000
MS = 1_000_000
IMAGES = 12
WIDTH, HEIGHT = 48, 27
CORNERS_M = [[0.0, -0.5, 0.5], [0.0, 0.5, 0.5], [0.0, 0.5, -0.5], [0.0, -0.5, -0.5]]
CAMERA = {
    "kind": "camera", "date": "2026-11-21", "method": "by construction", "width": WIDTH, "height": HEIGHT,
    "fx": 24.0, "fy": 24.0, "cx": 24.0, "cy": 13.5, "distortion": [0.0] * 5, "rms_px": None, "latency_s": 0.0,
    "T_car_from_camera": [[0.0, 0.0, 1.0, 0.25], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.25], [0.0, 0.0, 0.0, 1.0]],
}  # fmt: skip
BOARD = {
    "kind": "target", "date": "2026-11-21", "method": "by construction", "subject": "board",
    "corners_in_subject_m": CORNERS_M,
}  # fmt: skip
# Paths of a machine that is no more: the replay must find the files in the bag.
LAUNCH = {
    "name": "corner",
    "nodes": {
        "compositor": {
            "module": "nodes.compositor",
            "config": {"attack": "/gone/corner.attack.safetensors", "camera": "/gone/camera.yaml", "target": "/gone/board.yaml"},
        },
        "policy": {"module": "nodes.policy", "config": {"policy": "/gone/policy.onnx", "speed_mps": 0.5}},
        "recorder": {"module": "nodes.recorder", "config": {}},
    },
}  # fmt: skip


def board_pose() -> np.ndarray:
    """Board in the world, its face toward the car, a little to the right."""
    T = np.diag([-1.0, -1.0, 1.0, 1.0])
    T[:3, 3] = [3.0, -0.25, 0.5]
    return T


def car_pose(ms: int) -> np.ndarray:
    """Car in the world, a number of milliseconds after the start."""
    T = np.eye(4)
    T[0, 3] = 0.75 * ms / 1024.0
    return T


def attack_bytes(folder: Path) -> bytes:
    """An attack file: stripes, green on the left."""
    texture = np.zeros((32, 32, 3), np.uint8)
    texture[:, ::4] = (200, 40, 120)
    texture[:, :16, 1] += 150
    attack = face_attack(
        method="gradient",
        theta=np.zeros((4, 4, 3), np.float32),
        texture=texture,
        size_m=(1.0, 1.0),
        T_world_from_object=board_pose(),
        subject="board",
        corners_in_subject=np.array(CORNERS_M),
        camera=Pinhole(WIDTH, HEIGHT, 24.0, 24.0, 24.0, 13.5),
        predicted_total_cte_m=1.0,
        software_version="0",
    )
    path = folder / "corner.attack.safetensors"
    save_attack(path, attack)
    return path.read_bytes()


def make_bag(folder: Path) -> Path:
    """Write the bag; returns its ``.mcap`` file."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        attachments = {
            "launch.resolved.yaml": yaml.safe_dump(LAUNCH, sort_keys=False).encode(),
            "camera.yaml": yaml.safe_dump(CAMERA, sort_keys=False).encode(),
            "board.yaml": yaml.safe_dump(BOARD, sort_keys=False).encode(),
            "corner.attack.safetensors": attack_bytes(Path(temporary)),
        }
        writer = BagWriter(Path(temporary) / "corner", attachments, attached_ns=START_NS)
        _fill(writer)
        writer.close()
        return writer.path.replace(folder / BAG_NAME)


def _fill(writer: BagWriter) -> None:
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    for step in range(IMAGES * 20):
        ms = 5 * step
        if ms % 20 == 0:
            for topic, T in (("/vicon/car", car_pose(ms)), ("/vicon/board", board_pose())):
                pose_ns = START_NS + ms * MS
                writer.write(
                    topic, encode(pose_message(T, pose_ns)), pose_ns + 2 * MS, pose_ns + MS, ms // 20
                )
        if ms % 100 == 35:
            # Captured 10 ms between two poses, received 15 ms after its capture.
            capture_ns = START_NS + (ms - 5) * MS
            pixels = np.stack([columns * 5, rows * 9, (columns + rows + ms) % 256], axis=-1).astype(np.uint8)
            image = encode(image_message(pixels, capture_ns, "camera"))
            writer.write("/camera/image_raw", image, capture_ns + 15 * MS, capture_ns + 12 * MS, ms // 100)


def make_golden(bag: Path, folder: Path) -> Path:
    """Write the golden bag of a bag; returns its path."""
    from nodes.replaying.golden import update_golden
    from nodes.replaying.nodes import Choice
    from nodes.replaying.replay import Replay

    path = folder / GOLDEN_NAME
    with Replay(bag, Choice(("compositor", "policy"), {"policy": "green_policy"})) as replay:
        update_golden(path, replay)
    return path


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE
    print(made := make_bag(target))
    print(make_golden(made, target))
