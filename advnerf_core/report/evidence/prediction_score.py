"""Scores of predicted bands of deployed excess, drive by drive and set by set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaincinv

from advnerf_core.report.evidence.transfer_factor import Transfer

Floats = NDArray[np.float64]
LEVEL = 0.8


@dataclass(frozen=True)
class Score:
    """Comparison of one set's bands with its measured drives.

    Attributes:
        held: Number of drives within their bands.
        drives: Number of drives.
        score: Mean interval score, in the unit of the bands; smaller is better.
    """

    held: int
    drives: int
    score: float


def interval_score(low: ArrayLike, high: ArrayLike, measured: ArrayLike, level: float = LEVEL) -> Floats:
    """Interval score of each measured value (Gneiting and Raftery 2007, equation 43): width, and 2 / alpha times how far the value is outside."""
    lows, highs, values = (np.asarray(each, np.float64) for each in (low, high, measured))
    outside = np.maximum(lows - values, 0.0) + np.maximum(values - highs, 0.0)
    return np.asarray((highs - lows) + 2.0 / (1.0 - level) * outside)


def score_bands(bands: Floats, measured: Floats, level: float = LEVEL) -> Score:
    """Score bands ``[..., 2]`` of drives ``[...]``, both in one unit."""
    low, high = bands[..., 0], bands[..., 1]
    held = int(((low <= measured) & (measured <= high)).sum())
    return Score(held, measured.size, float(interval_score(low, high, measured, level).mean()))


def registered_bands(
    found: Transfer, predictions: Mapping[str, Mapping[str, Any]], half_lane_m: float
) -> Floats | None:
    """Bands ``[searches, starts, 2]`` that were registered before the drives, one for all drives of a search.

    Args:
        found: The drives of the set.
        predictions: By name of the cell, with ``excess_low_m`` and ``excess_high_m``; see `TransferPrediction.record`.
        half_lane_m: Length of half a lane [m].

    Returns:
        The bands; None if a search was not predicted.
    """
    if not all(name in predictions for name in found.cells):
        return None
    ends = [
        [predictions[name][f"excess_{end}_m"] / half_lane_m for end in ("low", "high")]
        for name in found.cells
    ]
    return np.repeat(np.array(ends)[:, None, :], found.surrogate.shape[1], axis=1)


def binomial_interval(held: int, count: int, level: float = 0.95) -> tuple[float, float]:
    """Interval of a share by Clopper and Pearson (1934): ``held`` of ``count`` independent observations."""
    if not 0 <= held <= count or count < 1:
        raise ValueError(f"expected some of at least one observation, got {held} of {count}")
    tail = 0.5 * (1.0 - level)
    low = 0.0 if held == 0 else float(betaincinv(held, count - held + 1, tail))
    high = 1.0 if held == count else float(betaincinv(held + 1, count - held, 1.0 - tail))
    return low, high
