"""Exact tests of registered comparisons, adjusted for multiple testing."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
MIN_SEARCHES = 6
MAX_SPLITS = 1_000_000
FEW_SEARCHES = "With fewer than six searches no test is claimed"


@dataclass(frozen=True)
class PermutationTest:
    """Result of an exact permutation test.

    Attributes:
        p: One-sided p-value; None if no test is claimed.
        difference: Mean of a minus mean of b, in the unit of the values.
        reason: Why p is None; empty otherwise.
    """

    p: float | None
    difference: float
    reason: str = ""


@dataclass(frozen=True)
class McNemar:
    """Result of McNemar's test of one search.

    Attributes:
        only_a: Number of starts from which only a left the track.
        only_b: Number of starts from which only b left the track.
        p: Two-sided exact p-value.
    """

    only_a: int
    only_b: int
    p: float


def permutation_test(a: ArrayLike, b: ArrayLike) -> PermutationTest:
    """Exact one-sided test that method a has the larger mean over searches.

    p is the share of all ``C(n + m, n)`` splits of the searches into two methods in which a is ahead by at
    least as much. The null hypothesis is that both methods draw their searches from one distribution.
    If both drive from the same starts, then the claim is about these starts only: p does not show whether
    a is better from new starts.

    Args:
        a: Mean over starts of each search of method a ``[n]``, larger is better.
        b: The same of method b ``[m]``, from the same starts.

    Returns:
        The test; its p is None, with the reason, if a or b has fewer than six searches.
    """
    ours, theirs = _search_means("a", a), _search_means("b", b)
    splits = math.comb(ours.size + theirs.size, ours.size)
    difference = float(ours.mean() - theirs.mean())
    if min(ours.size, theirs.size) < MIN_SEARCHES:
        return PermutationTest(None, difference, FEW_SEARCHES)
    if splits > MAX_SPLITS:
        raise ValueError(
            f"expected at most {MAX_SPLITS} splits of the searches, got {splits} from {ours.size} and "
            f"{theirs.size}; register fewer searches"
        )
    pooled = np.concatenate([ours, theirs])
    # Sums that differ by rounding, which grows with the values and not with what is left of them about their mean.
    rounding = 1e-12 * np.abs(pooled).sum()
    pooled -= pooled.mean()
    # The difference of means grows with the sum of a. Ties count against a.
    sums = pooled[_splits(ours.size, pooled.size)].sum(axis=1)
    observed = pooled[: ours.size].sum() - rounding
    return PermutationTest(np.count_nonzero(sums >= observed) / splits, difference)


def mcnemar_exact(only_a: int, only_b: int) -> float:
    """Two-sided exact p-value of McNemar's test: under no difference, each discordant pair is a fair coin.

    Args:
        only_a: Number of pairs in which only a has the event.
        only_b: Number of pairs in which only b has it.
    """
    for count in (only_a, only_b):
        if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 0:
            raise ValueError(
                f"expected two counts of pairs, got {only_a!r} and {only_b!r}; "
                "count the pairs in which only one has the event"
            )
    pairs, fewer = int(only_a + only_b), int(min(only_a, only_b))
    tail = sum(math.comb(pairs, k) for k in range(fewer + 1))
    # Whole numbers until the division make the p-value exact. With equal counts, the two tails overlap.
    return min(1.0, 2 * tail / (1 << pairs))


def mcnemar_per_search(off_a: ArrayLike, off_b: ArrayLike) -> tuple[McNemar, ...]:
    """McNemar's test of each search of an attack against a baseline, paired by start.

    Args:
        off_a: Whether each drive of each search of the attack left the track ``[searches, starts]``.
        off_b: The same of the baseline, from the same starts; its searches are compared row by row.
    """
    ours, theirs = np.asarray(off_a), np.asarray(off_b)
    if ours.ndim != 2 or ours.size == 0 or theirs.shape != ours.shape:
        raise ValueError(
            "expected off-track flags [searches, starts] of both a and b, "
            f"got shapes {list(ours.shape)} and {list(theirs.shape)}; drive both from the same starts"
        )
    if ours.dtype != np.bool_ or theirs.dtype != np.bool_:
        raise ValueError(
            f"expected off-track flags of type bool, got {ours.dtype} and {theirs.dtype}; "
            "compare |CTE| with the limit first"
        )
    only_a, only_b = (ours & ~theirs).sum(axis=1), (theirs & ~ours).sum(axis=1)
    return tuple(
        McNemar(int(one), int(other), mcnemar_exact(int(one), int(other)))
        for one, other in zip(only_a, only_b, strict=True)
    )


def holm(p_values: Sequence[float]) -> tuple[float, ...]:
    """Adjusted p-values of Holm's step-down procedure (1979), in the order given.

    Pass the registered primary tests, all of them, and nothing else. With the p-values in ascending order,
    the k-th of n becomes the largest of ``(n - i + 1) p_i`` over i <= k, at most 1. A test is significant at
    level alpha if its adjusted p-value is at most alpha.
    """
    ps = np.array([np.nan if p is None else p for p in p_values], dtype=np.float64)
    if ps.size == 0 or not ((ps >= 0.0) & (ps <= 1.0)).all():
        raise ValueError(
            f"expected one p-value within 0..1 for each registered test, got {list(p_values)}; "
            "a test without a p-value needs more searches"
        )
    order = np.argsort(ps)
    adjusted = np.empty_like(ps)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate((ps.size - np.arange(ps.size)) * ps[order]))
    return tuple(float(p) for p in adjusted)


@functools.lru_cache(maxsize=1)
def _splits(chosen: int, total: int) -> NDArray[np.uint8]:
    """All choices of ``chosen`` out of ``total`` searches ``[splits, chosen]``."""
    # MAX_SPLITS keeps the total far below 256, so a byte holds an index.
    indices = itertools.chain.from_iterable(itertools.combinations(range(total), chosen))
    return np.fromiter(indices, dtype=np.uint8).reshape(-1, chosen)


def _search_means(name: str, values: ArrayLike) -> Floats:
    means = np.asarray(values, dtype=np.float64)
    if means.ndim != 1 or means.size == 0 or not np.isfinite(means).all():
        raise ValueError(
            f"expected one finite mean for each search of {name} [n], got shape {list(means.shape)}: "
            f"{means.tolist()}; average each search over its starts first"
        )
    return means
