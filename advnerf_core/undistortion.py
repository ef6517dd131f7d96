"""Rays of the pixels of a distorted picture: the inverse of OpenCV's lens model, which has no closed form."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike

from advnerf_core.geometry import Array

# OpenCV's own 5 steps leave the outer pixels of a wide lens by tens of pixels; the widest that can be inverted needs about 100.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-6)
# A ray that is drawn farther from its pixel is none: the lens folds the picture before it reaches that pixel [px].
_MOST_OFF_PX = 0.5


def ray_slopes(pixels: ArrayLike, matrix: Array, distortion: Sequence[float]) -> Array:
    """Slopes x / z and y / z of rays through pixels.

    Args:
        pixels: ``[N, 2]`` [px], in the convention of ``matrix``.
        matrix: Intrinsics ``[3, 3]`` [px].
        distortion: OpenCV's coefficients k1, k2, p1, p2, k3.

    Returns:
        ``[N, 2]``; NaN for a pixel that no ray reaches.
    """
    points = np.asarray(pixels, np.float64).reshape(-1, 1, 2)
    coefficients = np.asarray(distortion, np.float64)
    one = np.eye(3)
    slopes = cv2.undistortPointsIter(points, matrix, coefficients, one, one, _CRITERIA).reshape(-1, 2)
    rays = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1).reshape(-1, 1, 3)
    drawn, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, coefficients)
    off_px = np.linalg.norm(drawn.reshape(-1, 2) - points[:, 0], axis=1)
    return np.asarray(np.where((off_px <= _MOST_OFF_PX)[:, None], slopes, np.nan))
