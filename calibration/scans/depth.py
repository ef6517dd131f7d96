"""Points of the scene from a few pixels of depth images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, Pinhole, invert_transform, transform_points

# Enough for a ground plane and a box.
_MOST_VIEWS, _COLUMNS, _ROWS = 40, 24, 18
# Each of these views is compared with those that come so many later.
_COMPARED_WITH = (1, 2, 4, 8)


@dataclass(frozen=True, eq=False)
class DepthView:
    """One depth image, aligned with a colour image.

    Attributes:
        file: PNG file of 16 bit, planar depth.
        pinhole: Intrinsics of the colour image.
        T_world_from_camera: Pose ``[4, 4]``, OpenCV axes.
        confidence: Image whose pixels are 255 where the depth is reliable; None if all is.
    """

    file: Path
    pinhole: Pinhole
    T_world_from_camera: Array
    confidence: Path | None = None


def depth_points(views: Sequence[DepthView], values_per_m: float, farthest_m: float) -> Array:
    """Points ``[M, 3]`` of evenly chosen depth images. Images that cannot be read are ignored.

    Args:
        values_per_m: Value of a pixel at one metre.
        farthest_m: Depth beyond which the sensor only guesses [m].
    """
    parts = [_points(view, values_per_m, farthest_m) for view in _chosen(views)]
    return np.concatenate([np.zeros((0, 3)), *parts])


def disagreement(views: Sequence[DepthView], values_per_m: float, farthest_m: float) -> float:
    """Median relative difference between the depth of a view's points in another view and that view's own depth; NaN without any.

    A wrong scale shows only where the views have parallax: a floor that is seen from one height agrees by any.
    """
    chosen = _chosen(views)
    differences = [
        _differences(_points(view, values_per_m, farthest_m), chosen[index + later], values_per_m)
        for index, view in enumerate(chosen)
        for later in _COMPARED_WITH
        if index + later < len(chosen)
    ]
    found = np.concatenate([np.zeros(0), *differences])
    return float(np.median(found)) if len(found) else float("nan")


def _chosen(views: Sequence[DepthView]) -> list[DepthView]:
    """Evenly chosen views."""
    if not views:
        return []
    count = min(len(views), _MOST_VIEWS)
    return [views[index] for index in np.unique(np.linspace(0, len(views) - 1, count).round().astype(int))]


def _differences(points: Array, view: DepthView, values_per_m: float) -> Array:
    """Relative differences ``[K]`` of the depth of points ``[M, 3]`` from a view's depth, where it has some."""
    values = _pixels(view.file)
    if values is None or not len(points):
        return np.zeros(0)
    height, width = values.shape
    local = transform_points(invert_transform(view.T_world_from_camera), points)
    local = local[local[:, 2] > 0.0]
    column, row = np.floor(view.pinhole.resized(width, height).project(local)).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    depth_m = values[row[inside].astype(int), column[inside].astype(int)] / values_per_m
    here_m = local[inside, 2]
    return np.asarray((np.abs(here_m - depth_m) / here_m)[depth_m > 0.0])


def _points(view: DepthView, values_per_m: float, farthest_m: float) -> Array:
    values = _pixels(view.file)
    if values is None:
        return np.zeros((0, 3))
    height, width = values.shape
    columns = np.linspace(0, width - 1, min(width, _COLUMNS)).round().astype(int)
    rows = np.linspace(0, height - 1, min(height, _ROWS)).round().astype(int)
    depth_m = values[np.ix_(rows, columns)] / values_per_m
    usable = (depth_m > 0.0) & (depth_m <= farthest_m)
    if view.confidence is not None:
        sure = _pixels(view.confidence)
        if sure is not None and sure.shape == values.shape:
            usable &= sure[np.ix_(rows, columns)] == 255
    rays = view.pinhole.resized(width, height).directions()[np.ix_(rows, columns)]
    return transform_points(view.T_world_from_camera, (rays * depth_m[..., None])[usable])


def _pixels(file: Path) -> NDArray[np.uint8 | np.uint16] | None:
    """Pixels ``[H, W]`` of a grey image; None if it cannot be read."""
    try:
        data = np.frombuffer(file.read_bytes(), np.uint8)
        pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    except (OSError, cv2.error):
        return None
    return None if pixels is None or pixels.ndim != 2 else pixels  # type: ignore[return-value]
