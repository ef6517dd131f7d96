"""Read a bag: what is in it, and the speed of the car from its poses.

    .venv/bin/python examples/read_a_bag.py [BAG]

Without a bag it writes a small one first, of a car on a circle. Bags of rosbag2 and of ROS 1 are read in the same way.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import planar_pose
from nodes.bags import BagWriter, read_info, read_messages
from nodes.runtime import decode, drive_message, encode, pose_matrix, pose_message, stamp_ns, topic

START_NS, PERIOD_NS = 1_800_000_000_000_000_000, 20_000_000
RADIUS_M, SPEED_MPS = 2.0, 0.8


def write_circle(folder: Path) -> Path:
    """Write five seconds of poses at 50 Hz and commands at 10 Hz; the folder of the bag."""
    with BagWriter(folder) as writer:
        for step in range(251):
            now_ns = START_NS + step * PERIOD_NS
            angle = SPEED_MPS / RADIUS_M * step * PERIOD_NS / 1e9
            pose = planar_pose(RADIUS_M * np.sin(angle), RADIUS_M * (1.0 - np.cos(angle)), angle)
            writer.write("/vicon/car", encode(pose_message(pose, now_ns)), now_ns, now_ns, step)
            if step % 5 == 0:
                command = drive_message(SPEED_MPS, np.arctan(0.25 / RADIUS_M), now_ns)
                writer.write("/policy/drive", encode(command), now_ns, now_ns, step // 5)
    return folder


def show(bag: Path) -> None:
    """Print the topics of a bag, and the mean speed of the car if its poses are in it."""
    info = read_info(bag)
    print(f"{info.messages} messages in {info.duration_s:.2f} s")
    for row in info.topics:
        print(f"  {row.name:20} {row.count:5} {row.type}")
    poses = [decode(topic("/vicon/car").type, found.cdr) for found in read_messages(bag, ["/vicon/car"])]
    times_s = np.array([stamp_ns(pose) - stamp_ns(poses[0]) for pose in poses]) / 1e9
    places_m = np.array([pose_matrix(pose)[:3, 3] for pose in poses])
    speeds_mps = np.linalg.norm(np.diff(places_m, axis=0), axis=1) / np.diff(times_s)
    print(f"mean speed {speeds_mps.mean():.3f} m/s")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        try:
            show(Path(sys.argv[1]) if len(sys.argv) > 1 else write_circle(Path(temporary) / "circle"))
        except AdvnerfError as error:
            raise SystemExit(f"error: {error}") from None
