"""A test that stays valid while searches are added: stop when it decides, or when the budget ends.

Under the null hypothesis all searches of both methods come from one distribution, so every order of their values is
equally likely. Under the alternative with odds c, the values of the attack have the distribution F^c if the baseline's
have F (Lehmann 1953): the largest value is an attack's with probability ``c n / (c n + m)``, and similarly
downwards. The ratio of the two probabilities of the observed order is a martingale under the null hypothesis
as searches are added, and so is its mean over several odds, the e-value. By Ville's inequality it ever reaches
``1 / alpha`` with probability at most alpha, for any rule that stops the experiment (Ramdas et al. 2023, "Game-theoretic
statistics and safe anytime-valid inference"). Which method the next search belongs to must be fixed beforehand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
# Small odds find small effects in many searches, large ones find separated methods in few. These find most between methods that are
# one to three standard deviations apart, in four to twelve pairs.
ODDS = (3.0, 9.0, 27.0)


@dataclass(frozen=True)
class AnytimeTest:
    """Result of the test over pairs of searches, one of each method, in the order in which they were added.

    Attributes:
        p: Anytime-valid one-sided p-value after the last pair: 1 / the largest e-value yet, at most 1.
        pairs: Pairs after which p was at most alpha for the first time; None if it never was.
        of_pairs: Total number of pairs.
    """

    p: float
    pairs: int | None
    of_pairs: int


def anytime_test(a: ArrayLike, b: ArrayLike, alpha: float = 0.05) -> AnytimeTest:
    """Test that method a has larger values than method b, after each pair of searches.

    Args:
        a: Mean over starts of each search of method a ``[n]``, in the order of its searches.
        b: The same of method b ``[m]``, from the same starts. Surplus searches of the longer one are ignored.
        alpha: Level of the test, within 0..1.
    """
    ours, theirs = (np.asarray(each, np.float64) for each in (a, b))
    count = min(ours.size, theirs.size)
    if ours.ndim != 1 or theirs.ndim != 1 or count == 0 or not np.isfinite([*ours, *theirs]).all():
        raise ValueError(
            f"expected one finite mean for each search of both methods, got shapes {list(ours.shape)} and "
            f"{list(theirs.shape)}; average each search over its starts first"
        )
    if not 0.0 < alpha < 1.0:
        raise ValueError(f"expected alpha within 0..1, got {alpha}; pass 0.05 for 5 %")
    found = np.maximum.accumulate(
        [float(e_value(ours[:pairs], theirs[:pairs])) for pairs in range(1, count + 1)]
    )
    # The bound itself counts as reached, even if rounding leaves the e-value below it.
    decided = np.flatnonzero(found >= (1.0 - 1e-12) / alpha)
    return AnytimeTest(min(1.0, 1.0 / float(found[-1])), int(decided[0]) + 1 if decided.size else None, count)


def e_value(a: ArrayLike, b: ArrayLike) -> Floats:
    """e-values ``[...]`` of searches ``[..., n]`` of method a and ``[..., m]`` of method b; large ones are evidence that a is larger.

    A value of a that ties with one of b, but for rounding, counts as the smaller one.
    """
    ours, theirs = np.asarray(a, np.float64), np.asarray(b, np.float64)
    rounding = 1e-12 * np.abs(np.concatenate([ours, theirs], axis=-1)).max(axis=-1, keepdims=True)
    values = np.concatenate([ours - rounding, theirs], axis=-1)
    is_ours = np.arange(values.shape[-1]) < ours.shape[-1]
    # Ascending; a stable sort keeps ours, which come first, below equal ones of theirs.
    ordered = is_ours[np.argsort(values, axis=-1, kind="stable")]
    logs = []
    for odds in ODDS:
        # From the largest value downwards, each is drawn from the remaining ones, with its weight.
        left = np.cumsum(np.where(ordered, odds, 1.0), axis=-1)
        logs.append(ours.shape[-1] * math.log(odds) - np.log(left).sum(axis=-1))
    return np.asarray(np.exp(np.array(logs) + math.lgamma(values.shape[-1] + 1)).mean(axis=0))
