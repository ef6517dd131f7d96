"""Mean, spread and confidence of few repetitions: ratios are of sums, intervals come from resampling whole seeds.

A seed is the unit that is repeated; the drives of one seed (its start poses) belong together and are resampled together. With up to five
seeds all ``n ** n`` resamples are taken, so the interval is exact and the same everywhere; with more they are drawn with a fixed seed.
Percentile intervals of so few seeds are narrow: Efron and Tibshirani 1993, "An Introduction to the Bootstrap", chapter 13.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
LEVEL = 0.95
_RESAMPLES = 10_000


@dataclass(frozen=True)
class Interval:
    """A confidence interval of a statistic.

    Attributes:
        low: Lower end.
        high: Upper end.
        level: Its coverage, as far as the bootstrap's promise goes.
    """

    low: float
    high: float
    level: float = LEVEL


def mean_and_std(values: Sequence[float]) -> tuple[float, float | None]:
    """Mean, and the standard deviation of a sample (n - 1); None of a single value."""
    if not values:
        raise ValueError("expected at least one value, got none")
    numbers = np.asarray(values, dtype=np.float64)
    return float(numbers.mean()), float(numbers.std(ddof=1)) if len(numbers) > 1 else None


def ratio_of_sums(numerator: ArrayLike, denominator: ArrayLike) -> float | None:
    """Sum over sum; None where the denominator is zero."""
    below = float(np.sum(denominator))
    return float(np.sum(numerator)) / below if below > 0.0 else None


def bootstrap(
    statistic: Callable[[Indices], Floats],
    count: int,
    level: float = LEVEL,
    resamples: int = _RESAMPLES,
    seed: int = 0,
) -> Interval | None:
    """Percentile interval of a statistic over ``count`` independent units.

    Args:
        statistic: Of resamples: indices ``[R, count]`` of units to values ``[R]``.
        count: Number of units, usually seeds.
        level: Coverage, within 0..1.
        resamples: How many are drawn; all ``count ** count`` are taken where that is fewer.
        seed: Of the draw.

    Returns:
        The interval; None of fewer than two units, which say nothing about spread, or where a resample has no value.
    """
    if not 0.0 < level < 1.0 or resamples < 1:
        raise ValueError(
            f"expected a level within 0..1 and at least one resample, got {level} and {resamples}"
        )
    if count < 2:
        return None
    values = np.sort(np.asarray(statistic(_resamples(count, resamples, seed)), dtype=np.float64))
    if not np.isfinite(values).all():
        return None
    tail = (1.0 - level) / 2.0
    # Of a discrete distribution the smallest value that leaves at most the tail outside, on either side.
    last = len(values) - 1
    low, high = math.floor(tail * last), math.ceil((1.0 - tail) * last)
    return Interval(float(values[low]), float(values[high]), level)


def _resamples(count: int, resamples: int, seed: int) -> Indices:
    if count**count <= resamples:
        return np.array(list(itertools.product(range(count), repeat=count)), dtype=np.int64)
    return np.random.default_rng(seed).integers(0, count, (resamples, count))


def ratio_interval(numerators: ArrayLike, denominators: ArrayLike, level: float = LEVEL) -> Interval | None:
    """Interval of a ratio of sums over seeds.

    Args:
        numerators: Sum of each seed ``[n]``.
        denominators: Sum of each seed ``[n]`` that it is divided by.
        level: Coverage.
    """
    above, below = np.asarray(numerators, np.float64), np.asarray(denominators, np.float64)
    _require_pairs(above, below)

    def ratios(chosen: Indices) -> Floats:
        return _divide(above[chosen].sum(axis=1), below[chosen].sum(axis=1))

    return bootstrap(ratios, len(above), level)


def transfer_interval(
    deployed: tuple[ArrayLike, ArrayLike], surrogate: tuple[ArrayLike, ArrayLike], level: float = LEVEL
) -> Interval | None:
    """Interval of the transfer ratio: deployed ratio over surrogate ratio, both of sums over the same seeds.

    Args:
        deployed: Attacked and unattacked sum of each seed, ``[n]`` each.
        surrogate: The same in the surrogate.
        level: Coverage.
    """
    parts = [np.asarray(part, np.float64) for part in (*deployed, *surrogate)]
    _require_pairs(*parts)

    def ratios(chosen: Indices) -> Floats:
        there, there_none, here, here_none = (part[chosen].sum(axis=1) for part in parts)
        return _divide(there * here_none, there_none * here)

    return bootstrap(ratios, len(parts[0]), level)


def _divide(above: Floats, below: Floats) -> Floats:
    return np.divide(above, below, out=np.full_like(above, np.nan), where=below > 0.0)


def _require_pairs(*parts: Floats) -> None:
    if any(part.ndim != 1 or part.shape != parts[0].shape for part in parts):
        raise ValueError(
            f"expected one number per seed in each, got shapes {[list(part.shape) for part in parts]}"
        )
