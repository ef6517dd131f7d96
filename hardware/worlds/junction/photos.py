"""Poses from which the intersection is photographed for learning: along the drives, off them, and from above."""

from __future__ import annotations

import math

import numpy as np

from advnerf_core.geometry import Array, camera_mount, look_at, planar_pose
from hardware.worlds.footprints import Footprint
from hardware.worlds.junction.config import IntersectionConfig
from hardware.worlds.junction.town import TREES, obstacles
from hardware.worlds.paths import ReferencePath

DRIVEN_M = 44.0  # photos cover this length of each path: the drive, and views of a car that overshoots
MAX_TRIES = 1000


def photo_poses(config: IntersectionConfig, count: int, rng: np.random.Generator) -> list[Array]:
    """Poses that cover the three drives evenly, mixed so that any prefix covers them too.

    Of ten photos six are taken close to a path at about the driving camera's height, two from a car that has left its lane
    and looks aside, and two from 3 to 7 m above the ground looking at the junction.

    Returns:
        ``T_world_from_camera`` ``[4, 4]`` each, none inside a house or a tree.
    """
    paths = list(config.paths().values())
    solid = [*obstacles(config), *(Footprint(t.x_m, t.y_m, t.radius_m, t.radius_m) for t in TREES)]
    poses = []
    for index in range(count):
        path, kind = paths[index % len(paths)], (index // len(paths)) % 10
        for _ in range(MAX_TRIES):
            pose = _pose(config, path, kind, rng)
            body = Footprint(float(pose[0, 3]), float(pose[1, 3]), 0.4, 0.4)
            if not any(body.overlaps(thing) for thing in solid):
                break
        else:
            raise ValueError("expected free space beside the paths to take photos from, found none")
        poses.append(pose)
    return poses


def _pose(config: IntersectionConfig, path: ReferencePath, kind: int, rng: np.random.Generator) -> Array:
    x, y, yaw = path.pose_at(float(rng.uniform(0.0, DRIVEN_M)))
    if kind in (4, 9):
        return _raised(x, y, rng)
    offset, turn = (1.6, 0.5) if kind in (3, 8) else (0.6, 0.12)
    aside = float(rng.normal(0.0, offset))
    car = planar_pose(
        x - aside * math.sin(yaw), y + aside * math.cos(yaw), yaw + float(rng.normal(0.0, turn))
    )
    height = config.camera.z_m + float(rng.uniform(-0.2, 0.4))
    pitch = config.camera.pitch_down_rad + float(rng.normal(0.0, math.radians(3.0)))
    return car @ camera_mount(config.camera.x_m, config.camera.y_m, height, pitch)


def _raised(x_m: float, y_m: float, rng: np.random.Generator) -> Array:
    """A raised view over the junction, as from a ladder: the ground from steeper angles than a car has."""
    position = np.array([x_m + rng.normal(), y_m + rng.normal(), rng.uniform(3.0, 7.0)])
    bearing = rng.uniform(0.0, 2.0 * math.pi)
    target = np.array([9.0 * math.cos(bearing), 9.0 * math.sin(bearing) - 4.0, 0.0])
    if math.dist(target[:2], position[:2]) < 4.0:  # never straight below
        target[:2] += 8.0 * np.array([math.cos(bearing), math.sin(bearing)])
    return look_at(position, target)
