"""All checks of one set, apart from digests and published numbers: its cells, its searches, and the files beside them.

Searches are distinct: each attack belongs to one search, and no drive was copied from another search. Predictions and the fidelity gate's
verdicts are consistent with the cells and with themselves.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.report.cells import CellResult
from advnerf_core.report.conditions import CONTROLS
from advnerf_core.report.evidence.registration import read_withdrawn
from advnerf_core.report.evidence.results import Evidence
from advnerf_core.report.evidence.verifying.drives import drive_problems
from advnerf_core.report.evidence.verifying.layout import cell_files
from advnerf_core.report.evidence.verifying.registered import build_problems, cell_problems, missing_cells
from advnerf_core.report.evidence.verifying.victims import declaration_problems, read_declared

_PREDICTIONS = ("predictions", "predictions_afterwards")
_CORRELATIONS = ("correlation", "ssim")


def set_problems(folder: Path, evidence: Evidence, under_way: bool = False) -> Iterator[str]:
    """Problems of the cells of a set and of the files beside them; while it is under way, cells may be missing."""
    damaged, withdrawn = under_way, read_withdrawn(folder)
    missing = [] if under_way else missing_cells(evidence, withdrawn)
    absent = (f"{name}: was registered, and is not there" for name in missing)
    for check in (
        absent,
        _name_problems(folder, evidence),
        cell_problems(evidence, withdrawn),
        drive_problems(evidence),
    ):
        for problem in check:
            damaged = True
            yield problem
    yield from build_problems(evidence)
    yield from _search_problems(evidence)
    yield from _prediction_problems(folder, evidence)
    yield from _gate_problems(folder, evidence)
    if not damaged:
        yield from declaration_problems(evidence, read_declared(folder))


def _name_problems(folder: Path, evidence: Evidence) -> Iterator[str]:
    """Whether each file is of the cell that it is named after: of two files of one cell, only one would count."""
    for file, cell in zip(cell_files(folder), evidence.all_cells, strict=True):
        if file.stem != cell.name:
            yield f"{file}: expected the cell of this name, got {cell.name}; restore both from git, or remove the copy"


def _search_problems(evidence: Evidence) -> Iterator[str]:
    """Whether each search has its own attack, possibly driven under several conditions."""
    attacked = [cell for cell in evidence.cells.values() if cell.method not in CONTROLS]
    yield from _attacks(attacked)
    yield from _copies(attacked)
    yield from _shared_searches(evidence, attacked)


def _attacks(attacked: list[CellResult]) -> Iterator[str]:
    """Whether an attack belongs to one search: under another condition it has the same victim, method and seed."""
    searches: dict[str, tuple[str, str, int]] = {}
    for cell in attacked:
        if cell.attack_id is None:
            yield f"{cell.name}: expected the id of its attack, got none"
            continue
        search = (cell.victim, cell.method, cell.seed)
        if (first := searches.setdefault(cell.attack_id, search)) != search:
            other = "_".join(map(str, first))
            yield f"{cell.name}: its attack {cell.attack_id} is that of another search, {other}"


def _copies(attacked: list[CellResult]) -> Iterator[str]:
    """Whether two searches have the same drive."""
    seen: dict[tuple[object, ...], CellResult] = {}
    for cell in attacked:
        for domain, drives in cell.kept.items():
            for number, drive in enumerate(drives):
                key = (cell.scenario, domain, drive.x_m, drive.y_m)
                first = seen.setdefault(key, cell)
                if first is not cell:
                    yield f"{cell.name}, {domain}, start {number}: is the drive of {first.name}"


def _shared_searches(evidence: Evidence, attacked: list[CellResult]) -> Iterator[str]:
    """Whether an attack under several conditions has the same drives in the learned scene under each, from the same starts."""
    first: dict[tuple[object, ...], CellResult] = {}
    for cell in attacked:
        starts = evidence.scenario_of(cell).starts
        stages = tuple(sorted(cell.stages.items()))
        other = first.setdefault((cell.attack_id, starts, stages, cell.policy_sha256), cell)
        if cell.kept.get("surrogate") != other.kept.get("surrogate"):
            yield f"{cell.name}: its drives in the learned scene are not those of {other.name}, which has the same attack"


def _prediction_problems(folder: Path, evidence: Evidence) -> Iterator[str]:
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


def _gate_problems(folder: Path, evidence: Evidence) -> Iterator[str]:
    """Whether each verdict of the fidelity gate belongs to a victim of this set, passed unless it lists a reason, and has possible numbers."""
    victims = {f"{cell.scenario}_{cell.victim}" for cell in evidence.cells.values()}
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
