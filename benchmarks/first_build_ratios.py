"""Ratios of the first build's totals, as its rows of the ledger were recorded: nothing else computes them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from advnerf_core.documents import read_json
from advnerf_core.report.cells import CellResult, Drives
from advnerf_core.report.conditions import CONTROLS
from advnerf_core.report.reference import Domain
from nodes.experiment.run.predictions import prediction_file

_RESAMPLES, _TAIL = 10_000, 0.025
# An attack that makes the car stray by this ratio counted as one that works.
_WORKS_FROM = 1.5
# Mean totals of the paper by scenario, domain and method, in its own units.
_JUNCTION = {
    "straight": {"surrogate": {"random": 1132, "gradient": 2347}, "deployed": {"none": 1166, "random": 1193, "gradient": 1702}},
    "right": {"surrogate": {"random": 2084, "gradient": 4105}, "deployed": {"none": 1315, "random": 1476, "gradient": 2101}},
    "left": {"surrogate": {"random": 1460, "gradient": 4125}, "deployed": {"none": 1448, "random": 1158, "gradient": 2240}},
}  # fmt: skip
_CAR = {
    "green_screen": {"surrogate": {"random": 34, "gradient": 157}, "deployed": {"none": 48, "random": 46, "gradient": 248}},
    "monitor": {"surrogate": {"random": 34, "gradient": 157}, "deployed": {"none": 48, "random": 47, "gradient": 76}},
}  # fmt: skip
PAPER_TOTALS: dict[str, dict[str, dict[str, int]]] = {**_JUNCTION, **_CAR}


def paper_ratio(scenario: str, domain: Domain, method: str) -> float | None:
    """The paper's total over that of its deployed drive without attack; None where it has none."""
    totals = PAPER_TOTALS.get(scenario, {})
    found = totals.get(domain, {}).get(method)
    return found / totals["deployed"]["none"] if found else None


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


def skill_text(folder: Path, cells: Sequence[CellResult]) -> tuple[float, str, list[str]] | None:
    """Median factor between predicted and deployed ratio, how good the predictions were in words, and the cells; None without any."""
    names, expected, measured = (
        [],
        [],
        [],
    )  # of expected and measured: ratio and total [m]; of plain what the surrogate says
    plain = []
    for cell in cells:
        file = prediction_file(folder, cell.name)
        said = read_json(file) if file.exists() else {}
        if (
            cell.deployed is None
            or cell.method in CONTROLS
            or said.get("settings_hash") != cell.settings_hash
        ):
            continue
        starts = min(len(cell.surrogate.total_cte_m), len(cell.deployed.total_cte_m))
        learned, learned_plain = (
            sum(each[:starts]) for each in (cell.surrogate.total_cte_m, cell.surrogate.none_total_cte_m)
        )
        names.append(cell.name)
        expected.append((said["ratio"], said["total_cte_m"]))
        measured.append(
            (sum(cell.deployed.total_cte_m) / sum(cell.deployed.none_total_cte_m), cell.deployed.mean_m)
        )
        plain.append((learned / learned_plain, learned / starts))
    if not names:
        return None
    truth = np.array(measured)
    factor, total_factor, rank, right = _skill(np.array(expected), truth)
    plain_factor, plain_total, plain_rank, plain_right = _skill(np.array(plain), truth)
    text = (
        f"{len(names)} attacks predicted and deployed: the ratio is off by a factor of {factor:.2f} in the median, the total CTE by "
        f"{total_factor:.2f}{rank}; {right} of {len(names)} rightly said to work (at least {_WORKS_FROM:g} × no attack) or not. "  # noqa: RUF001
        f"The drives in the learned scene taken for the prediction would be off by {plain_factor:.2f} and {plain_total:.2f}{plain_rank}, "
        f"{plain_right} of {len(names)} right."
    )
    return factor, text, names


def _skill(expected: np.ndarray, measured: np.ndarray) -> tuple[float, float, str, int]:
    """Median factors of ratio and total ``[n, 2]``, rank correlation in words, and how many were rightly said to work."""
    logs = np.abs(np.log(np.maximum(expected, 1e-9) / np.maximum(measured, 1e-9)))
    factors = np.exp(np.median(logs, axis=0))
    ratios, truth = expected[:, 0], measured[:, 0]
    ranked = len(ratios) >= 3 and np.ptp(ratios) > 0.0 and np.ptp(truth) > 0.0
    rank = f", rank correlation {spearmanr(ratios, truth).statistic:.2f}" if ranked else ""
    return (
        float(factors[0]),
        float(factors[1]),
        rank,
        int(((ratios >= _WORKS_FROM) == (truth >= _WORKS_FROM)).sum()),
    )


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
