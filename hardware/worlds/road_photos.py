"""Poses from which a road is photographed for learning: along its lanes, off them, and from above."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from advnerf_core.geometry import Array, camera_mount, look_at, planar_pose
from hardware.worlds.lab.config import CameraConfig
from hardware.worlds.paths import ReferencePath

_BEHIND, _RAISED, _AHEAD = 1.5, (1.5, 4.0), 4.0


def road_photo_poses(
    paths: Sequence[ReferencePath],
    lane_width_m: float,
    camera: CameraConfig,
    count: int,
    rng: np.random.Generator,
) -> list[Array]:
    """Poses that cover the paths evenly, mixed so that any prefix covers them too.

    Of ten photographs six are taken close to a lane's middle at about the driving camera's height, two from a car that has left its lane and
    looks aside, and two from above the lane, looking along it or across it. Lengths are in units of the camera's height and the lane's width, so
    that a street of model cars is photographed as a street of cars.

    Returns:
        ``T_world_from_camera`` ``[4, 4]`` each.
    """
    poses = []
    for index in range(count):
        path, kind = paths[index % len(paths)], (index // len(paths)) % 10
        behind_m = 0.0 if path.closed else _BEHIND * lane_width_m
        x, y, yaw = path.pose_at(float(rng.uniform(-behind_m, path.length_m)))
        if kind in (4, 9):
            poses.append(_raised(x, y, yaw, lane_width_m, camera, rng))
            continue
        aside_m, turn_rad = (0.15 * lane_width_m, 0.12) if kind not in (3, 8) else (0.4 * lane_width_m, 0.5)
        aside = float(np.clip(rng.normal(0.0, aside_m), -lane_width_m, lane_width_m))
        car = planar_pose(
            x - aside * math.sin(yaw), y + aside * math.cos(yaw), yaw + float(rng.normal(0.0, turn_rad))
        )
        poses.append(car @ _held(camera, rng))
    return poses


def _held(camera: CameraConfig, rng: np.random.Generator) -> Array:
    height = camera.z_m * (1.0 + float(rng.uniform(-0.13, 0.27)))
    pitch = camera.pitch_down_rad + float(rng.normal(0.0, math.radians(3.0)))
    return camera_mount(camera.x_m, camera.y_m, height, pitch)


def _raised(
    x_m: float,
    y_m: float,
    yaw_rad: float,
    lane_width_m: float,
    camera: CameraConfig,
    rng: np.random.Generator,
) -> Array:
    position = np.array([x_m, y_m, camera.z_m * rng.uniform(*_RAISED)])
    course = yaw_rad + float(rng.normal(0.0, 0.8))
    ahead = _AHEAD * lane_width_m * float(rng.uniform(0.7, 1.6))
    return look_at(position, [x_m + ahead * math.cos(course), y_m + ahead * math.sin(course), 0.0])
