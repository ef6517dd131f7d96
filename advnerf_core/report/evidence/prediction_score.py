"""How good predicted bands of excess were, drive by drive, and whether they beat a predictor that knows the surrogate and the past alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.report.cells import CellResult
from advnerf_core.report.conditions import CONTROLS
from advnerf_core.report.evidence.results import Evidence

Floats = NDArray[np.float64]
LEVEL = 0.8
_ENDS = (0.5 * (1.0 - LEVEL), 0.5 * (1.0 + LEVEL))


@dataclass(frozen=True)
class ScoredCell:
    """The prediction of one attack against its deployed drives. Lengths in half lanes, per tick.

    Attributes:
        name: Of the cell.
        method: Which search found the attack.
        band: Predicted band of a drive's excess.
        trivial_band: As the surrogate says, with the spread of the past.
        measured: Excess of each deployed drive.
        score: Mean interval score of the band over the drives; smaller is better.
        trivial_score: The same of the trivial band.
    """

    name: str
    method: str
    band: tuple[float, float]
    trivial_band: tuple[float, float]
    measured: tuple[float, ...]
    score: float
    trivial_score: float

    @property
    def held(self) -> int:
        """Drives within the band."""
        return sum(self.band[0] <= value <= self.band[1] for value in self.measured)


def interval_score(low: float, high: float, measured: ArrayLike, level: float = LEVEL) -> Floats:
    """Interval score of each measured value (Gneiting and Raftery 2007, equation 43): width, and 2 / alpha times how far the value is outside."""
    values, alpha = np.asarray(measured, np.float64), 1.0 - level
    outside = np.maximum(low - values, 0.0) + np.maximum(values - high, 0.0)
    return np.asarray((high - low) + 2.0 / alpha * outside)


def past_differences(past: Sequence[Evidence]) -> Floats:
    """Deployed minus surrogate excess of all attacked drives of earlier sets, start by start [half lanes per tick]."""
    found: list[float] = []
    for evidence in past:
        for cell in evidence.cells.values():
            if cell.method not in CONTROLS:
                learned, deployed = (_excess(evidence, cell, domain) for domain in ("surrogate", "deployed"))
                found += [real - said for said, real in zip(learned, deployed, strict=False)]
    return np.array(found)


def score_cells(
    evidence: Evidence, predictions: Mapping[str, Mapping[str, Any]], past: Sequence[Evidence]
) -> list[ScoredCell]:
    """Score every deployed attack of a set that was predicted.

    Args:
        evidence: The set.
        predictions: By name of the cell, with ``excess_low_m`` and ``excess_high_m``; see `TransferPrediction.record`.
        past: Sets that were known before.

    Raises:
        ValueError: The past has no attacked drive.
    """
    differences, found = past_differences(past), []
    if not differences.size:
        raise ValueError("expected attacked drives in the earlier sets, got none; name a published set")
    for name, said in sorted(predictions.items()):
        cell = evidence.cells.get(name)
        if cell is None or cell.method in CONTROLS or not cell.kept.get("deployed"):
            continue
        half_lane_m = evidence.scenario_of(cell).off_track_m
        band = (float(said["excess_low_m"]) / half_lane_m, float(said["excess_high_m"]) / half_lane_m)
        spread = np.add.outer(_excess(evidence, cell, "surrogate"), differences).ravel()
        trivial = tuple(map(float, np.quantile(spread, _ENDS)))
        measured = _excess(evidence, cell, "deployed")
        scores = [float(interval_score(low, high, measured).mean()) for low, high in (band, trivial)]
        found.append(ScoredCell(name, cell.method, band, (trivial[0], trivial[1]), tuple(measured), *scores))
    return found


def _excess(evidence: Evidence, cell: CellResult, domain: Any) -> list[float]:
    half_lane_m = evidence.scenario_of(cell).off_track_m
    return [outcome.excess_cte_m_per_tick / half_lane_m for outcome in evidence.outcomes(cell, domain)]
