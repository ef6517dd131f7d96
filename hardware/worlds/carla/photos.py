"""Poses from which a junction of a CARLA map is photographed for learning: along the lanes, off them, and from above."""

from __future__ import annotations

import math

import numpy as np

from advnerf_core.geometry import Array, camera_mount, look_at, planar_pose
from hardware.worlds.carla.config import CarlaConfig
from hardware.worlds.carla.drives import JunctionDrives
from hardware.worlds.lab.config import CameraConfig

BEHIND_M = 4.0  # photographs begin this far before the drives' starts
DRIVEN_M = 44.0  # and end this far after them: the drive, and what a car sees that overshoots


def photo_poses(
    drives: JunctionDrives, config: CarlaConfig, count: int, rng: np.random.Generator
) -> list[Array]:
    """Poses that cover the three drives evenly, mixed so that any prefix covers them too.

    Of ten photographs six are taken close to a lane's middle at about the driving camera's height, two from a car that has left
    its lane and looks aside, and two from 3 to 6 m above a lane towards the junction. The surroundings of the
    road are unknown, so no camera goes farther from a lane's middle than about a lane's width.

    Returns:
        ``T_world_from_camera`` ``[4, 4]`` each.
    """
    paths = list(drives.paths.values())
    poses = []
    for index in range(count):
        path, kind = paths[index % len(paths)], (index // len(paths)) % 10
        x, y, yaw = path.pose_at(float(rng.uniform(-BEHIND_M, min(DRIVEN_M, path.length_m))))
        if kind in (4, 9):
            poses.append(_raised(x, y, rng))
            continue
        aside_m, turn_rad = (
            (0.15 * drives.lane_width_m, 0.12) if kind not in (3, 8) else (0.4 * drives.lane_width_m, 0.5)
        )
        aside = float(np.clip(rng.normal(0.0, aside_m), -drives.lane_width_m, drives.lane_width_m))
        turned = yaw + float(rng.normal(0.0, turn_rad))
        car = planar_pose(x - aside * math.sin(yaw), y + aside * math.cos(yaw), turned)
        poses.append(car @ _held(config.camera, rng))
    return poses


def _held(camera: CameraConfig, rng: np.random.Generator) -> Array:
    height = camera.z_m + float(rng.uniform(-0.2, 0.4))
    pitch = camera.pitch_down_rad + float(rng.normal(0.0, math.radians(3.0)))
    return camera_mount(camera.x_m, camera.y_m, height, pitch)


def _raised(x_m: float, y_m: float, rng: np.random.Generator) -> Array:
    position = np.array([x_m, y_m, rng.uniform(3.0, 6.0)])
    bearing = float(rng.uniform(0.0, 2.0 * math.pi))
    # Somewhere on the ground about the junction's middle, never straight below.
    target = np.array([8.0 * math.cos(bearing), 8.0 * math.sin(bearing), 0.0])
    if math.dist(target[:2], position[:2]) < 4.0:
        target[:2] += 8.0 * np.array([math.cos(bearing), math.sin(bearing)])
    return look_at(position, target)
