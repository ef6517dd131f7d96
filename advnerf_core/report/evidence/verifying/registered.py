"""Whether the cells of a set match the registration: which, with what search, when, and of one build."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from datetime import datetime
from typing import Any

from advnerf_core.report.cells import CellResult
from advnerf_core.report.conditions import CONTROLS
from advnerf_core.report.evidence.registration import RegisteredScenario, settings_differences
from advnerf_core.report.evidence.results import Evidence


def missing_cells(evidence: Evidence, withdrawn: Collection[str]) -> list[str]:
    """Registered cells that are not there, though their scenario was not withdrawn."""
    there = {cell.name for cell in evidence.all_cells}
    registered = (each for each in evidence.registration.cells if each.scenario not in withdrawn)
    return [each.name for each in registered if each.name not in there]


def cell_problems(evidence: Evidence, withdrawn: Collection[str]) -> Iterator[str]:
    """Whether no cell passes for registered that is not, and none is of a withdrawn scenario."""
    there = {cell.name for cell in evidence.all_cells}
    for scenario in sorted(set(withdrawn) - {cell.scenario for cell in evidence.registration.cells}):
        yield f"{scenario}: was withdrawn, and was not registered"
    for wanted in evidence.registration.cells:
        name = wanted.name
        if wanted.scenario in withdrawn:
            if name in there:
                yield f"{name}: is there, and its scenario was withdrawn"
        elif name in evidence.cells and not evidence.is_registered(evidence.cells[name]):
            yield f"{name}: was registered, and was not run under this registration"
    for cell in evidence.all_cells:
        if cell.not_driven_live:
            yield f"{cell.name}: was not driven live and is no evidence: {cell.not_driven_live}"
        elif cell.name not in evidence.cells:
            yield f"{cell.name}: expected a cell of a registered scenario with its drives kept"
        elif not evidence.is_registered(cell) and cell.registration:
            yield f"{cell.name}: says that it was registered, and was not"
        elif evidence.is_registered(cell):
            yield from _as_registered(evidence, cell)


def _as_registered(evidence: Evidence, cell: CellResult) -> Iterator[str]:
    """Whether a cell's own notes on its search and limits match the registration, and it is no older than that."""
    scenario = evidence.scenario_of(cell)
    evaluations = 0 if cell.method in CONTROLS else scenario.evaluations
    wanted = {
        "evaluations": evaluations,
        "space": scenario.space,
        "horizon": scenario.ticks,
        "off_track_m": scenario.off_track_m,
    }
    for key, value in wanted.items():
        if (found := cell.extra.get(key, value)) != value:  # an older cell has no such note
            yield f"{cell.name}: expected {key} {value} as registered, got {found}"
    if bool(scenario.settings) > bool(cell.settings):
        yield f"{cell.name}: expected its settings, as the registration has them, got none"
    registered = {**_settings_of(scenario, cell.victim), **scenario.pinned(cell.victim, cell.method)}
    # Its policy is the one that drove, also in cells from before their settings were stored.
    for text in settings_differences(registered, {**cell.settings, "policy_sha256": cell.policy_sha256}):
        yield f"{cell.name}: expected the registered settings, got {text}"
    clip = str(cell.extra.get("clip") or cell.name)
    if not clip.startswith(cell.name):
        yield f"{cell.name}: names the clip of another cell, {clip}"
    registered_on = evidence.registration.date
    if not _not_before(cell.date, registered_on):
        yield f"{cell.name}: expected a date from {registered_on} on, when it was registered, got {cell.date}"


def _settings_of(scenario: RegisteredScenario, victim: str) -> Mapping[str, Any]:
    """The registered settings of a victim's cells: one with a recipe of its own has its own training and architecture."""
    recipe = scenario.settings.get("recipes", {}).get(victim)
    if recipe is None:
        return scenario.settings
    policy = {name: recipe[name] for name in scenario.settings["policy"]}
    architecture = {name: value for name, value in recipe.items() if name not in policy}
    return {**scenario.settings, "policy": policy, "architecture": architecture}


def _not_before(date: str, other: str) -> bool:
    try:
        return datetime.fromisoformat(date) >= datetime.fromisoformat(other)
    except (ValueError, TypeError):  # no date, or one without a time zone
        return False


def build_problems(evidence: Evidence) -> Iterator[str]:
    """Whether all cells of a scenario have the same stages, and each victim is one policy."""
    stages: dict[tuple[str, str], str] = {}
    parts: dict[str, set[str]] = {}
    policies: dict[tuple[str, str], str] = {}
    for cell in evidence.cells.values():
        place = cell.scenario
        # The stage of a victim with a recipe of its own is policy-NAME.
        part = {name.partition("-")[0] for name in cell.stages}
        if part != parts.setdefault(place, part) or any(
            digest != stages.setdefault((place, name), digest) for name, digest in cell.stages.items()
        ):
            yield f"{cell.name}: was run with other stages than the cells before it"
        victim = (place, cell.victim)
        if cell.policy_sha256 != policies.setdefault(victim, cell.policy_sha256):
            yield f"{cell.name}: was run against another policy than the other cells of this victim"
    by_place: dict[str, list[str]] = {}
    for (scenario, _), digest in policies.items():
        by_place.setdefault(scenario, []).append(digest)
    for scenario, found in by_place.items():
        if len(set(found)) != len(found):
            yield f"{scenario}: two victims are one policy"
