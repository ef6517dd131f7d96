"""Boxes of scenes whose files have none: from silhouettes, or around the cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.views import ImageSet
from advnerf_core.geometry import Array, invert_transform, transform_points

# Margin of the content beyond the cameras, as a share of their longest side.
CAMERA_MARGIN = 0.5
_MOST_VIEWS, _CELLS, _ROUNDS = 32, 40, 3
# A cell belongs to the object if at least this share of the views shows it, and none of them shows it transparent.
_SEEN_SHARE = 0.5
_OPAQUE = 128


def box_around_cameras(T_world_from_camera: Array) -> tuple[Array, Array]:
    """Low and high corner ``[3]`` of a box around cameras ``[N, 4, 4]`` with a margin, for the inner region of an unbounded scene."""
    places = T_world_from_camera[:, :3, 3]
    low, high = places.min(axis=0), places.max(axis=0)
    margin = CAMERA_MARGIN * float((high - low).max())
    return low - margin, high + margin


def box_of_silhouettes(images: ImageSet) -> tuple[Array, Array] | None:
    """Low and high corner ``[3]`` of the box around the object whose silhouettes are in the images' opacity; None if there is no such box.

    The box is that of the visual hull (Laurentini 1994), on a grid that is drawn closer in each round.
    """
    if images.alpha is None:
        return None
    centre = _looked_at(images.T_world_from_camera)
    reach = float(np.median(np.linalg.norm(images.T_world_from_camera[:, :3, 3] - centre, axis=1)))
    low, high = centre - reach, centre + reach
    for _ in range(_ROUNDS):
        cell = (high - low) / _CELLS
        axes = [
            np.linspace(a + 0.5 * c, b - 0.5 * c, _CELLS) for a, b, c in zip(low, high, cell, strict=True)
        ]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        inside = points[_in_hull(points, images)]
        if not len(inside):
            return None
        low, high = inside.min(axis=0) - 1.5 * cell, inside.max(axis=0) + 1.5 * cell
    return low, high


def _looked_at(poses: Array) -> Array:
    """Point ``[3]`` nearest to all optical axes."""
    axes = poses[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(axis=0) + 1e-9 * len(poses) * np.eye(3)  # all axes may be parallel
    return np.asarray(np.linalg.solve(total, np.einsum("nij,nj->i", across, poses[:, :3, 3])))


def _in_hull(points: Array, images: ImageSet) -> NDArray[np.intp]:
    """Indices of the points ``[M, 3]`` that are in the visual hull."""
    assert images.alpha is not None
    count = len(images.rgb)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_VIEWS)).round().astype(int))
    left: NDArray[np.intp] = np.arange(len(points))
    seen = np.zeros(len(points), np.int64)
    for index in chosen:
        pinhole, T = images.pinholes[index], invert_transform(images.T_world_from_camera[index])
        local = transform_points(T, points[left])
        pixels = np.nan_to_num(np.floor(pinhole.project(local)), nan=-1.0, posinf=-1.0, neginf=-1.0)
        size = (pinhole.width, pinhole.height)
        shown = (local[:, 2] > 0.0) & ((pixels >= 0.0) & (pixels < size)).all(axis=1)
        columns, rows = pixels[shown].astype(np.int64).T
        kept = np.ones(len(left), np.bool_)
        kept[shown] = images.alpha[index][rows, columns] >= _OPAQUE
        seen[left] += shown
        left = left[kept]
    return left[seen[left] >= _SEEN_SHARE * len(chosen)]
