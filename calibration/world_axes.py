"""Gives a model of photographs an upright world: z up, from the ground or from how people hold cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from advnerf_core.data.similarity import Similarity, extent
from advnerf_core.geometry import Array, make_transform
from calibration.photo_model import Model, ReconstructionError

# Weight against the spread of the x axes. It is small, so that the axes decide as soon as the cameras have turned a little.
_LEVEL_WEIGHT = 0.005
# The ground is searched among planes that are at most this steep against the cameras' up [rad].
_STEEPEST_RAD = np.radians(20.0)
# Points within this share of the cameras' median distance from the points lie on a plane.
_THICKNESS = 0.01
_MIN_POINTS, _MIN_SHARE = 50, 0.05
# Reflections put some points below the ground, and wrong poses a camera.
_BELOW_SHARE = 0.1
_DRAWS, _DRAWN_POINTS = 1000, 4000


@dataclass(frozen=True, eq=False)
class Ground:
    """A plane ``up x = height`` under the cameras, in the model's world.

    Attributes:
        up: Unit normal ``[3]``, towards the cameras.
        height: Height of the plane along ``up``.
        points: Number of points on the plane.
    """

    up: Array
    height: float
    points: int


def cameras_up(poses: Array) -> Array:
    """Up ``[3]`` of a model with camera poses ``[N, 4, 4]``.

    It is the mean up direction of the cameras, pulled towards the direction perpendicular to all their x axes, because people hold a
    camera level more accurately than they point it straight ahead.
    """
    sideways, up = poses[:, :3, 0], -poses[:, :3, 1].mean(axis=0)
    up = np.linalg.solve(sideways.T @ sideways / len(poses) + _LEVEL_WEIGHT * np.eye(3), up)
    length = float(np.linalg.norm(up))
    return up / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])


def find_ground(poses: Array, points: Array, up: Array | None = None) -> Ground | None:
    """The plane of most points ``[M, 3]`` below the cameras and nearly level; None if no plane has enough points.

    Args:
        up: Up ``[3]``; None takes the cameras'.
    """
    up, positions = cameras_up(poses) if up is None else up, poses[:, :3, 3]
    below = points[points @ up < np.median(positions @ up)]
    if len(below) < _MIN_POINTS:
        return None
    rng = np.random.default_rng(0)
    thickness = _THICKNESS * float(np.median(np.linalg.norm(below - positions.mean(axis=0), axis=1)))
    drawn = (
        below if len(below) <= _DRAWN_POINTS else below[rng.choice(len(below), _DRAWN_POINTS, replace=False)]
    )
    best, best_count = None, 0
    for a, b, c in drawn[rng.integers(len(drawn), size=(_DRAWS, 3))]:
        plane = _plane(np.cross(b - a, c - a), a, up)
        if plane is None or not _is_under(plane, positions, drawn, thickness):
            continue
        count = int(np.sum(np.abs(drawn @ plane[0] - plane[1]) < thickness))
        if count > best_count:
            best, best_count = plane, count
    if best is None:
        return None
    for _ in range(5):  # to a fixed point
        on = below[np.abs(below @ best[0] - best[1]) < thickness]
        refined = _plane(np.linalg.svd(on - on.mean(axis=0), full_matrices=False)[2][2], on.mean(axis=0), up)
        if refined is None:
            return None
        best = refined
    count = int(np.sum(np.abs(below @ best[0] - best[1]) < thickness))
    enough = count >= max(_MIN_POINTS, _MIN_SHARE * len(points))
    return Ground(*best, count) if enough and _is_under(best, positions, below, thickness) else None


def _plane(normal: Array, point: Array, up: Array) -> tuple[Array, float] | None:
    """Unit normal and height of a plane through a point; None if it is too steep."""
    length = float(np.linalg.norm(normal))
    if length == 0.0 or abs(normal @ up) < np.cos(_STEEPEST_RAD) * length:
        return None
    normal = normal / (length if normal @ up > 0.0 else -length)
    return normal, float(point @ normal)


def _is_under(plane: tuple[Array, float], positions: Array, points: Array, thickness: float) -> bool:
    cameras = np.mean(positions @ plane[0] - plane[1] < thickness)
    return bool(max(cameras, np.mean(points @ plane[0] - plane[1] < -2.0 * thickness)) <= _BELOW_SHARE)


def extent_scale(model: Model, extent_m: float) -> float:
    """Factor that makes the distance between the two cameras that are farthest apart ``extent_m`` [m].

    Raises:
        ReconstructionError: All cameras are at one place.
    """
    spread = extent(model.poses[:, :3, 3])
    if spread <= 0.0:
        raise ReconstructionError(
            "expected photographs from different places, got all from one; move the camera instead of only turning it"
        )
    return extent_m / spread


def on_ground(model: Model, ground: Ground | None, scale: float) -> Similarity:
    """Similarity that makes z up and multiplies lengths by ``scale``.

    With a ground, that is z = 0, and the origin lies below the middle of the points. Without it, the origin is that middle.
    """
    up = cameras_up(model.poses) if ground is None else ground.up
    aside = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0], up)
    x = aside / np.linalg.norm(aside)
    R = np.stack([x, np.cross(up, x), up])
    middle = np.median(model.points, axis=0) if len(model.points) else model.poses[:, :3, 3].mean(axis=0)
    if ground is not None:
        middle = middle - (middle @ up - ground.height) * up
    return Similarity(scale, make_transform(R, -scale * R @ middle))


def upright(R_upright_from_model: Array, model: Model, ground: Ground | None, scale: float) -> Similarity:
    """Similarity for a model whose rotation ``[3, 3]`` to z up is known: its origin is kept, but for a ground, which comes to z = 0."""
    up, height = R_upright_from_model[2], 0.0
    if ground is not None:  # below the middle of the cameras
        middle = model.poses[:, :3, 3].mean(axis=0)
        height = float(up @ middle - (ground.up @ middle - ground.height) / (ground.up @ up))
    return Similarity(scale, make_transform(R_upright_from_model, [0.0, 0.0, -scale * height]))
