"""Scores of predicted bands of deployed excess, drive by drive and set by set."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
LEVEL = 0.8


@dataclass(frozen=True)
class Score:
    """Comparison of one set's bands with its measured drives.

    Attributes:
        held: Number of drives within their bands.
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


def score_bands(bands: Floats, measured: Floats) -> Score:
    """Score bands ``[..., 2]`` of drives ``[...]``, both in one unit."""
    low, high = bands[..., 0], bands[..., 1]
    held = int(((low <= measured) & (measured <= high)).sum())
    return Score(held, measured.size, float(interval_score(low, high, measured).mean()))
