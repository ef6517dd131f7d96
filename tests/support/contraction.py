"""The contraction of `advnerf_core.render.contraction` as its formula says, which the kernels are compared with."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def contract(points: ArrayLike) -> NDArray[np.float64]:
    """Points ``[..., 3]`` in box coordinates, anywhere, to the unit cube."""
    y = 2.0 * np.asarray(points, np.float64) - 1.0
    r = np.abs(y).max(axis=-1, keepdims=True)
    largest = np.arange(3) == np.abs(y).argmax(axis=-1)[..., None]
    outside = np.where(largest, np.sign(y) * (2.0 - 1.0 / np.maximum(r, 1.0)), y / np.maximum(r, 1.0))
    return np.asarray(0.25 * np.where(r <= 1.0, y, outside) + 0.5)
