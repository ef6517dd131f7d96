"""Ratios of the first build's totals, as its rows of the ledger were recorded: nothing else computes them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from advnerf_core.report.cells import CellResult, Drives

_RESAMPLES, _TAIL = 10_000, 0.025


def seeds_interval(drives: Sequence[Drives]) -> tuple[float, float] | None:
    """Percentile bootstrap of a ratio of sums over whole seeds, too narrow for so few; None of one seed."""
    if len(drives) < 2:
        return None
    attacked, plain = _sums(drives)
    chosen = _resamples(len(drives))
    values = np.sort(attacked[chosen].sum(axis=1) / plain[chosen].sum(axis=1))
    last = len(values) - 1
    return float(values[math.floor(_TAIL * last)]), float(values[math.ceil((1.0 - _TAIL) * last)])


def transfer_ratio(cells: Sequence[CellResult]) -> float | None:
    """Deployed ratio over that in the surrogate, from the starts that both have; None where nothing was deployed."""
    both = [(cell.surrogate, cell.deployed) for cell in cells if cell.deployed is not None]
    if not both:
        return None
    counts = [min(len(here.total_cte_m), len(there.total_cte_m)) for here, there in both]
    ratios = []
    for side in (1, 0):
        attacked, plain = _sums([pair[side] for pair in both], counts)
        ratios.append(float(attacked.sum() / plain.sum()))
    return ratios[0] / ratios[1]


def _sums(drives: Sequence[Drives], counts: Sequence[int] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Sum of each seed with the attack and past the plain object, over its first drives ``[n]``."""
    firsts = counts or [len(each.total_cte_m) for each in drives]
    pairs = list(zip(drives, firsts, strict=True))
    attacked = np.array([sum(each.total_cte_m[:first]) for each, first in pairs])
    return attacked, np.array([sum(each.none_total_cte_m[:first]) for each, first in pairs])


def _resamples(count: int) -> np.ndarray:
    """All resamples of whole seeds ``[R, count]`` where they are few; else drawn ones."""
    if count**count <= _RESAMPLES:
        return np.array(list(itertools.product(range(count), repeat=count)))
    return np.random.default_rng(0).integers(0, count, (_RESAMPLES, count))
