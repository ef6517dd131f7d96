"""The visual hull of an object from its silhouettes, where a fit to photographs starts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, invert_transform, transform_points
from advnerf_core.objects.voxel.pictures import FitError, PosedRgba
from advnerf_core.objects.voxel.voxelise import OPAQUE_PER_VOXEL, ObjectGrids

_SEEN_THROUGH = 0.1
_COARSE, _FINE = 48, 96
_MARGIN_VOXELS = 1
_ROUNDING = 1e-6
# The hull is never smaller than the object, so its border starts half transparent and may vanish.
_START_SHARE = 0.5


def visual_hull(views: PosedRgba, resolution: int = 64) -> ObjectGrids:
    """Grids over the box around the hull, half dense inside it, in the mean colour of the pictures.

    Args:
        views: Pictures from around the object; space that one of them shows empty is empty.
        resolution: Voxels along the longest side of the box.

    Raises:
        FitError: The silhouettes have nothing in common, or the cameras do not look at one place.
    """
    views.refuse_useless()
    centre, radius = _looked_at(views)
    coarse = _carve(views, centre - radius, 2 * radius / _COARSE, (_COARSE,) * 3)
    if not coarse.any():
        raise FitError(
            "expected silhouettes that agree on an object, they have no point in common: are the poses right?"
        )
    low, high = _box_of(coarse, centre - radius, 2 * radius / _COARSE)
    # Repeat with finer cells: voxels beside the object are wasted.
    step = float((high - low).max()) / _FINE
    fine = _carve(views, low, step, tuple(np.ceil((high - low) / step).astype(int)))
    if fine.any():  # a thin thread may lie between the cells' centres
        low, high = _box_of(fine, low, step)
    voxel = float((high - low).max()) / (resolution - 2 * _MARGIN_VOXELS)
    counts = np.ceil((high - low) / voxel - _ROUNDING).astype(int) + 2 * _MARGIN_VOXELS
    box_min = (low + high) / 2 - 0.5 * voxel * counts
    inside = _carve(views, box_min, voxel, tuple(counts))
    # Picture by picture: a sum over all at once would copy them.
    sums = np.sum([image.sum(axis=(0, 1), dtype=np.float64) for image in views.images], axis=0)
    mean = sums[:3] / max(sums[3], views.white)
    density = np.where(inside, _START_SHARE * OPAQUE_PER_VOXEL / voxel, 0.0).astype(np.float32)
    colours = np.broadcast_to(mean, (*counts, 3)).astype(np.float32)
    return ObjectGrids(density, colours, box_min, box_min + voxel * counts)


def _box_of(inside: NDArray[np.bool_], origin: Array, step: float) -> tuple[Array, Array]:
    """Corners of the box around the cells of edge ``step`` that are inside, and one cell more on each side."""
    filled = np.argwhere(inside)
    return origin + step * (filled.min(axis=0) - 1), origin + step * (filled.max(axis=0) + 2)


def _looked_at(views: PosedRgba) -> tuple[Array, float]:
    """The point nearest to all optical axes, and half the distance of the nearest camera to it."""
    T = np.asarray(views.T_object_from_camera, dtype=np.float64)
    eyes, axes = T[:, :3, 3], T[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(axis=0)
    if np.linalg.cond(normal) > 1e6:
        raise FitError("expected pictures from around the object, all cameras look the same way")
    centre = np.linalg.solve(normal, np.einsum("nij,nj->i", across, eyes))
    return centre, 0.5 * float(np.linalg.norm(eyes - centre, axis=1).min())


def _carve(views: PosedRgba, box_min: Array, voxel: float, counts: tuple[int, ...]) -> NDArray[np.bool_]:
    """Voxels whose centre no picture sees through, and at least half of the pictures show."""
    axes = [low + voxel * (np.arange(count) + 0.5) for low, count in zip(box_min, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    kept, shown_in = np.ones(len(points), dtype=bool), np.zeros(len(points))
    for image, T, lens in zip(views.images, views.T_object_from_camera, views.pinholes, strict=True):
        seen = transform_points(invert_transform(np.asarray(T)), points)
        ahead = seen[:, 2] > 1e-6
        z = np.where(ahead, seen[:, 2], 1.0)
        u = np.floor(lens.fx * seen[:, 0] / z + lens.cx)
        v = np.floor(lens.fy * seen[:, 1] / z + lens.cy)
        within = ahead & (u >= 0) & (v >= 0) & (u < lens.width) & (v < lens.height)
        alpha = image[v[within].astype(int), u[within].astype(int), 3]
        kept[np.flatnonzero(within)[alpha < _SEEN_THROUGH * views.white]] = False
        shown_in += within
    return np.asarray((kept & (shown_in >= 0.5 * len(views.images))).reshape(counts))
