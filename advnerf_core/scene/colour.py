"""Colour maps between cameras: the camera that learned a scene differs from the one that drives through it.

The map goes from learned colours ``a`` to driving colours ``b`` in two steps: each channel is straightened by a power, because phones
store tone-mapped values, then mixed by an affine map: ``b = M a^g + offset``. Powers are found by search, the rest by least
squares in closed form, so a fit is deterministic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from advnerf_core.plain import PlainData

_POWERS = (0.3, 3.0)
# Twelve numbers and a power are fitted: more pairs change the result by less than 8 bits resolve, and cost minutes.
_MOST_PAIRS = 50_000
# Share of the pairs with the largest errors that a second fit leaves out: at edges a render is displaced, not differently coloured.
_TRIM = 0.1


@dataclass(frozen=True)
class ColourMap(PlainData):
    """Map from the colours of one camera to those of another.

    Attributes:
        matrix: ``M``, row by row ``[3][3]``.
        offset: ``[3]``.
        power: ``g``.
    """

    matrix: tuple[tuple[float, float, float], ...]
    offset: tuple[float, float, float]
    power: float = 1.0

    def apply(self, rgb: NDArray[np.float32]) -> NDArray[np.float32]:
        """Map colours ``[..., 3]`` in 0..1; results are clipped to 0..1."""
        matrix, offset = np.array(self.matrix, np.float32), np.array(self.offset, np.float32)
        straight = np.maximum(rgb, np.float32(0.0)) ** np.float32(self.power)
        # Contiguous 2-d product: the order of summation then does not depend on the image size.
        mapped = straight.reshape(-1, 3) @ matrix.T + offset
        return np.clip(mapped, np.float32(0.0), np.float32(1.0)).reshape(rgb.shape)


IDENTITY = ColourMap(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0))


def fit_colour_map(learned: ArrayLike, driving: ArrayLike) -> ColourMap:
    """Fit a map from paired colours.

    Args:
        learned: Rendered colours ``[..., 3]`` in 0..1.
        driving: Colours of the driving camera at the same pixels, same shape (uint8 is divided by 255).
    """
    a, b = _pairs(learned), _pairs(driving)
    if a.shape != b.shape or len(a) < 16:
        raise ValueError(f"expected at least 16 paired colours, got {a.shape} and {b.shape}")
    if len(a) > _MOST_PAIRS:
        # A fixed random choice: a regular one would be in step with the rows of the images.
        chosen = np.random.default_rng(0).choice(len(a), _MOST_PAIRS, replace=False)
        a, b = a[chosen], b[chosen]
    finite = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    if finite.sum() < 16:
        raise ValueError(f"expected at least 16 pairs of finite colours, got {int(finite.sum())}")
    a, b = a[finite], b[finite]
    keep = np.ones(len(a), bool)
    for _ in range(2):
        x, y = a[keep], b[keep]
        found = minimize_scalar(lambda g, x=x, y=y: _solve(x, y, g)[1], bounds=_POWERS, method="bounded")
        power = float(found.x)
        solution = _solve(x, y, power)[0]
        error = np.abs(_design(a, power) @ solution - b).max(axis=1)
        keep = error <= np.quantile(error, 1.0 - _TRIM)
    rows = tuple((float(r[0]), float(r[1]), float(r[2])) for r in solution[:3].T)
    offset = solution[3]
    return ColourMap(rows, (float(offset[0]), float(offset[1]), float(offset[2])), power)


def _pairs(colours: ArrayLike) -> NDArray[np.float64]:
    values = np.asarray(colours)
    scale = 255.0 if values.dtype == np.uint8 else 1.0
    return values.reshape(-1, 3) / np.float64(scale)


def _design(colours: NDArray[np.float64], power: float) -> NDArray[np.float64]:
    return np.concatenate([np.maximum(colours, 0.0) ** power, np.ones((len(colours), 1))], axis=1)


def _solve(a: NDArray[np.float64], b: NDArray[np.float64], power: float) -> tuple[NDArray[np.float64], float]:
    design = _design(a, power)
    solution = np.asarray(np.linalg.lstsq(design, b, rcond=None)[0], np.float64)
    return solution, float(np.mean((design @ solution - b) ** 2))
