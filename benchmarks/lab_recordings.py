"""What a person would record in the lab: a phone's photographs and video, and the bag of a drive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from advnerf_core.geometry import Array, camera_mount, planar_pose
from calibration.by_construction import write_twin_calibrations
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.lab import Lab
from hardware.worlds.lab.phone import track_length, track_pose
from nodes.bags.writer import BagWriter
from nodes.runtime.messages import encode, image_message, pose_message

START_NS = 1_800_000_000_000_000_000
FRAME_PERIOD_S, POSE_PERIOD_S = 0.1, 0.01
# What a VICON system of this size leaves after its own calibration.
POSE_NOISE_M, POSE_NOISE_RAD = 0.0003, 0.0005


def lab_with_phone(width: int) -> LabConfig:
    """The lab, its phone with another resolution: at 640 x 480 a smooth wall shows few corners."""
    return LabConfig.model_validate({"phone": {"width": width, "height": width * 3 // 4}})


def photograph(lab: Lab, poses: Sequence[Array], folder: Path) -> list[Path]:
    """Phone photographs as JPEG files, named by their number."""
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for index, pose in enumerate(poses):
        files.append(folder / f"{index:04d}.jpg")
        cv2.imwrite(str(files[-1]), lab.photograph(pose)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    return files


def video_poses(config: LabConfig, count: int) -> list[Array]:
    """A video filmed on three laps along the track: looking across the room, looking at the walls, then low and ahead.

    Neighbours overlap, as structure from motion needs, and the last lap sees what a driving camera sees.

    Args:
        count: Number of frames over all laps.

    Returns:
        ``T_world_from_camera`` ``[4, 4]`` each.
    """
    # Height [m], angle of view to the left of the way [rad], pitch down [rad].
    laps = (
        (1.5, math.radians(65.0), math.radians(14.0)),
        (1.2, math.radians(-40.0), math.radians(6.0)),
        (0.4, 0.0, math.radians(8.0)),
    )
    length, poses = track_length(config.track), []
    for index in range(count):
        along = len(laps) * index / count
        height, yaw, pitch = laps[int(along)]
        # A person neither walks straight nor holds a phone still; the periods have no common multiple, so that no two laps are alike.
        sway_m, bob_m = 0.12 * math.sin(2.3 * index), 0.06 * math.sin(1.7 * index)
        pose = planar_pose(*track_pose(config.track, length * (along % 1.0)))
        poses.append(
            pose @ camera_mount(0.0, sway_m, height + bob_m, pitch, yaw + 0.08 * math.sin(0.9 * index))
        )
    return poses


def car_state(lab: LabConfig, time_s: float) -> tuple[float, float, float]:
    """Where the car is on a drive round the track that weaves a little."""
    s_m = lab.car.speed_mps * time_s
    x, y, yaw = track_pose(lab.track, s_m)
    offset = 0.12 * math.sin(1.3 * s_m)
    return x - offset * math.sin(yaw), y + offset * math.cos(yaw), yaw + 0.12 * 1.3 * math.cos(1.3 * s_m)


def record_drive(lab: Lab, bag: Path, laps: float = 1.0, seed: int = 0) -> Path:
    """A bag as the recorder writes it: frames, motion-capture poses with their noise, and the calibration files."""
    config, rng = lab.config, np.random.default_rng(seed)
    files = write_twin_calibrations(config, bag.parent / f"{bag.name}_calibration")
    seconds = laps * track_length(config.track) / config.car.speed_mps
    with BagWriter(bag, {path.name: path.read_bytes() for path in files.values()}) as writer:
        sequence = 0
        for index in range(round(seconds / FRAME_PERIOD_S)):
            for step in range(round(FRAME_PERIOD_S / POSE_PERIOD_S)):
                time_s = index * FRAME_PERIOD_S + step * POSE_PERIOD_S - 0.004
                pose = planar_pose(*_noisy(car_state(config, time_s), rng))
                stamp = START_NS + round(1e9 * time_s)
                writer.write("/vicon/car", encode(pose_message(pose, stamp)), stamp, stamp, sequence)
                sequence += 1
            rgb, _ = lab.observe_at(*car_state(config, index * FRAME_PERIOD_S), depth=False)
            stamp = START_NS + round(1e9 * index * FRAME_PERIOD_S)
            writer.write(
                "/camera/image_raw", encode(image_message(rgb, stamp, "camera")), stamp, stamp, index
            )
    return bag


def _noisy(state: tuple[float, float, float], rng: np.random.Generator) -> tuple[float, float, float]:
    x, y, yaw = np.asarray(state) + rng.normal(0.0, [POSE_NOISE_M, POSE_NOISE_M, POSE_NOISE_RAD])
    return float(x), float(y), float(yaw)
