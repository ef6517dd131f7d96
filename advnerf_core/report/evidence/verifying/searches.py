"""Whether searches are distinct: each attack belongs to one search, and no drive was copied from another search."""

from __future__ import annotations

from collections.abc import Iterator

from advnerf_core.report.cells import CellResult
from advnerf_core.report.conditions import CONTROLS
from advnerf_core.report.evidence.results import Evidence


def search_problems(evidence: Evidence) -> Iterator[str]:
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
                key = (cell.scenario, cell.placement, domain, drive.x_m, drive.y_m)
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
