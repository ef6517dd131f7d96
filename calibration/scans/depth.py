"""Points of the scene from a few pixels of depth images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, Pinhole, transform_points

# Enough for a ground plane and a box.
_MOST_VIEWS, _COLUMNS, _ROWS = 40, 24, 18


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
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), _MOST_VIEWS)).round().astype(int))
    parts = [_points(views[index], values_per_m, farthest_m) for index in chosen] if len(views) else []
    return np.concatenate([np.zeros((0, 3)), *parts])


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
