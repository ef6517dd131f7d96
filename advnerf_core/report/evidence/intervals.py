"""Intervals of a mean excess over searches and starts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.report.evidence.mean_estimate import MeanEstimate, crossed, difference, one_sample

Floats = NDArray[np.float64]
Over = Literal["searches and starts", "searches", "starts"]
LEVEL = 0.95
# Smallest and largest coverage [%] of 95 % intervals of six searches from twenty starts, rounded, over the designs of `benchmarks/coverage.py`.
MEASURED_COVERAGE = (89.0, 99.0)


@dataclass(frozen=True)
class ClusteredInterval:
    """Two-sided confidence interval of a mean, in the unit of its values.

    Attributes:
        mean: Mean over searches of their means over starts.
        low: Lower end.
        high: Upper end.
        over: The population of the interval. ``"searches and starts"``: new searches driven from new
            starts. ``"searches"``: new searches driven from this one start. ``"starts"``: this one search
            driven from new starts.
    """

    mean: float
    low: float
    high: float
    over: Over


def clustered_interval(
    values: Iterable[ArrayLike], level: float = LEVEL, shared_starts: bool = True
) -> ClusteredInterval | None:
    """Interval of the mean over searches and starts.

    The drives of one search are correlated, and so are the drives from one start. The interval accounts
    for both, and is for the mean of new searches driven from new starts.

    With six searches and twenty shared starts, 95 % intervals cover 93 to 98 % for normal and for moderately
    skewed effects. They cover less if a few searches in the population differ strongly from the rest: six
    searches cannot show how heavy its tail is. At equal normal effects, intervals of three searches cover
    92 %, and of two 89 %. The measured coverages are the rows of ``benchmarks/coverage.py``.

    Values without any spread give an interval of zero width, so do not use it for shares of drives.

    Args:
        values: One row for each search, one value for each start ``[searches][starts]``, e.g. excess CTE [m].
        level: Coverage, within 0..1.
        shared_starts: Whether column j is the same start for all searches. If not, each search has its own
            starts, rows may differ in length, and the search means are one sample.

    Returns:
        The interval, or None for fewer than two values. With one search, it is over starts alone.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"expected a level within 0..1, got {level}; pass 0.95 for 95 %")
    rows = _rows(values, shared_starts)
    found = _estimate(rows, shared_starts)
    return _interval(*found, level) if found else None


def difference_interval(one: ArrayLike, other: ArrayLike, level: float = LEVEL) -> ClusteredInterval | None:
    """Interval of one method's mean minus another's, over new searches of both and new starts.

    Only starts are paired. The order of the searches does not matter, and the methods may have different
    numbers of searches.

    Args:
        one: Values of one method ``[searches, starts]``, e.g. excess CTE [m].
        other: Values of the other method ``[searches, starts]``, from the same starts in the same order.
        level: Coverage, within 0..1.

    Returns:
        The interval, or None if a method has fewer than two searches, or there are fewer than two starts.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"expected a level within 0..1, got {level}; pass 0.95 for 95 %")
    ours, theirs = (np.stack(_rows(list(np.atleast_2d(each)), True)) for each in (one, other))
    if ours.shape[1] != theirs.shape[1]:
        raise ValueError(
            f"expected the same starts for both methods, got {ours.shape[1]} and {theirs.shape[1]}; keep those that both have"
        )
    if min(*ours.shape, *theirs.shape) < 2:
        return None
    return _interval(difference(ours, theirs), "searches and starts", level)


def _rows(values: Iterable[ArrayLike], shared_starts: bool) -> list[Floats]:
    """One array ``[starts]`` for each search, checked."""
    rows = [np.asarray(row, dtype=np.float64) for row in values]
    if not rows or any(row.ndim != 1 or row.size == 0 for row in rows):
        raise ValueError(
            "expected a row of at least one start for each search, got shapes "
            f"{[list(row.shape) for row in rows]}; pass [[...]] for one search"
        )
    if not all(np.isfinite(row).all() for row in rows):
        raise ValueError("expected finite values, got NaN or infinity; repeat the drives that have no value")
    lengths = sorted({row.size for row in rows})
    if shared_starts and len(lengths) > 1:
        raise ValueError(
            f"expected the same starts for all searches, got rows of {lengths} starts; keep the starts that "
            "all have, or pass shared_starts=False if each search has its own"
        )
    return rows


def _estimate(rows: list[Floats], shared_starts: bool) -> tuple[MeanEstimate, Over] | None:
    """Estimate the mean, and name the population of its standard error."""
    if len(rows) == 1:
        return (one_sample(rows[0]), "starts") if rows[0].size > 1 else None
    if not shared_starts:
        return one_sample(np.array([row.mean() for row in rows])), "searches and starts"
    if rows[0].size == 1:
        return one_sample(np.concatenate(rows)), "searches"
    return crossed(np.stack(rows)), "searches and starts"


def _interval(estimate: MeanEstimate, over: Over, level: float) -> ClusteredInterval:
    low, high = estimate.ends(level)
    return ClusteredInterval(float(estimate.mean), float(low), float(high), over)
