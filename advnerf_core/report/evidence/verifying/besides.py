"""Whether the predictions and the fidelity gate's verdicts beside the cells are consistent with the cells and with themselves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.report.conditions import CONTROLS
from advnerf_core.report.evidence.registration import scenario_key
from advnerf_core.report.evidence.results import Evidence

_PREDICTIONS = ("predictions", "predictions_afterwards")
_CORRELATIONS = ("correlation", "ssim")


def prediction_problems(folder: Path, evidence: Evidence) -> Iterator[str]:
    """Whether each prediction belongs to an attacked cell with these settings, and its numbers are consistent."""
    for file in sorted(path for part in _PREDICTIONS for path in folder.glob(f"{part}/*.json")):
        cell = evidence.cells.get(file.stem)
        if cell is None or cell.method in CONTROLS:
            yield f"{file}: expected a prediction of an attacked cell of this set"
            continue
        try:
            said = read_json(file)
            if said["settings_hash"] != cell.settings_hash:
                yield f"{file}: is of other settings than its cell"
            yield from (f"{file}: {text}" for text in _disagrees(said, evidence.scenario_of(cell).ticks))
        except (OSError, ValueError, KeyError, TypeError) as error:
            yield f"{file}: cannot be read: {error!r}"


def _disagrees(said: Mapping[str, Any], ticks: int) -> Iterator[str]:
    """Excess and ratio follow from the predicted totals; the middle lies within its band."""
    total_m, none_m = said["total_cte_m"], said["none_total_cte_m"]
    if not np.isclose(said["excess_m"], (total_m - none_m) / ticks, rtol=1e-6, atol=1e-9):
        yield "its excess is not that of its totals"
    if none_m > 0.0 and not np.isclose(said["ratio"], total_m / none_m, rtol=1e-6):
        yield "its ratio is not that of its totals"
    for low, high in (("excess_low_m", "excess_high_m"), ("ratio_low", "ratio_high")):
        if not said[low] <= said[high]:
            yield f"{low} is above {high}"


def gate_problems(folder: Path, evidence: Evidence) -> Iterator[str]:
    """Whether each verdict of the fidelity gate belongs to a victim of this set, passed unless it lists a reason, and has possible numbers."""
    victims = {
        f"{scenario_key(cell.scenario, cell.placement)}_{cell.victim}" for cell in evidence.cells.values()
    }
    verdicts: dict[str, Any] = {}
    for file in sorted(folder.glob("gate/*.json")):
        if file.name.split(".drive.json")[0].removesuffix(".json") not in victims:
            yield f"{file}: expected a verdict on a victim of this set"
        try:
            said = read_json(file)
            numbers = said["numbers"]
            if said["passed"] != (not said["reasons"]):
                yield f"{file}: expected it to have passed where it has no reason against it, and nowhere else"
            if any(not -1.0 <= numbers[name] <= 1.0 for name in _CORRELATIONS) or not (
                0.0 <= numbers["steering"] <= numbers["steering_worst"]
            ):
                yield f"{file}: its numbers are not possible"
            # Scenarios with the same scene and victim share the held-out views, but each may drive past them with another car.
            if not file.name.endswith(".drive.json") and verdicts.setdefault(said["key"], said) != said:
                yield f"{file}: another verdict than that of the same scene and victim beside it"
        except (OSError, ValueError, KeyError, TypeError) as error:
            yield f"{file}: cannot be read: {error!r}"
