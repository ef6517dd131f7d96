"""The best random search of a published set: what an attacker without a gradient reaches."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from advnerf_core.driving.metrics import no_effect_m
from advnerf_core.report.cells import CellResult, read_cell
from advnerf_core.report.conditions import CONTROLS, style_of
from advnerf_core.report.evidence.families import COARSE_SEARCHES, RANDOM_ALONE, RANDOM_FAMILIES
from advnerf_core.report.evidence.registration import read_registration
from advnerf_core.report.evidence.results import Evidence
from advnerf_core.report.evidence.rows import Key, Outcome
from advnerf_core.report.reference import DOMAINS
from nodes.experiment.plan.victims import NAIVE


@dataclass(frozen=True)
class Reached:
    """Results of the searches of one method in one domain.

    Attributes:
        best_m: Excess of the best search, mean over its starts [m per tick].
        off_track: Drives of the best search that left the track.
        drives: Drives of the best search.
        mean_m: Excess, mean over all searches [m per tick].
        all_off_track: Drives of all searches that left the track.
        all_drives: Drives of all searches.
    """

    best_m: float
    off_track: int
    drives: int
    mean_m: float
    all_off_track: int
    all_drives: int

    @property
    def text(self) -> str:
        """All of it as text."""
        return (
            f"up to {self.best_m:.3f} m per tick ({self.off_track} of {self.drives} drives off the track), {self.mean_m:.3f} m in the mean of the "
            f"searches ({self.all_off_track} of {self.all_drives})"
        )


@dataclass(frozen=True)
class Strongest:
    """The method without a gradient that moves a deployed victim most in one scenario.

    Attributes:
        scenario: Name of the scenario.
        victim: Name of the victim.
        method: The method.
        searches: Number of searches.
        evaluations: Textures that each search tried.
        surrogate: Results in the learned scene.
        deployed: Results in the deployment.
        margin_m: Largest excess of a victim that may be called hardened [m per tick].
    """

    scenario: str
    victim: str
    method: str
    searches: int
    evaluations: int
    surrogate: Reached
    deployed: Reached
    margin_m: float

    @property
    def how(self) -> str:
        """Settings of the searches, as text."""
        searches = "one search," if self.searches == 1 else f"{self.searches} searches, each"
        return f"{style_of(self.method).title}, {searches} the best of {self.evaluations} textures"


def strongest_random(folder: Path) -> list[Strongest]:
    """The strongest method without a gradient in a published set, against victims that learned from textures; empty if none was deployed.

    Of conditions that share their searches only the last counts, in which everything is the world's own.

    Args:
        folder: Folder of the set.
    """
    registration = read_registration(folder)
    if registration is None:
        return []
    wanted = {*RANDOM_FAMILIES, *COARSE_SEARCHES, *CONTROLS}
    cells = [cell for file in sorted(folder.glob("*.json")) if (cell := read_cell(file)).method in wanted]
    evidence = Evidence(registration, cells)
    by_place: defaultdict[tuple[str, str], list[CellResult]] = defaultdict(list)
    for cell in evidence.cells.values():
        searched = cell.victim != NAIVE and cell.method not in CONTROLS
        if evidence.scenario_of(cell).space.get("kind") in RANDOM_ALONE:
            continue  # random places or shapes, no textures
        if searched and cell.kept.get("deployed") and evidence.without(cell):
            by_place[cell.scenario, cell.victim].append(cell)
    last = {frozenset(each.attack_id for each in searches): searches for searches in by_place.values()}
    found = [
        [_of_method(evidence, key) for key in dict.fromkeys(each.key for each in searches)]
        for searches in last.values()
    ]
    return [max(each, key=lambda strongest: strongest.deployed.best_m) for each in found]


def _of_method(evidence: Evidence, key: Key) -> Strongest:
    searches = [cell for cell in evidence.searches(key) if cell.kept.get("deployed")]
    surrogate, deployed = (
        _reached([evidence.outcomes(cell, domain) for cell in searches]) for domain in DOMAINS
    )
    scenario = evidence.scenario_of(searches[0])
    margin_m = no_effect_m(scenario.off_track_m)
    return Strongest(*key, len(searches), scenario.evaluations, surrogate, deployed, margin_m)


def _reached(outcomes: Sequence[Sequence[Outcome]]) -> Reached:
    means = [float(np.mean([each.excess_cte_m_per_tick for each in found])) for found in outcomes]
    off = [sum(each.off_track for each in found) for found in outcomes]
    best = int(np.argmax(means))
    return Reached(
        means[best], off[best], len(outcomes[best]), float(np.mean(means)), sum(off), sum(map(len, outcomes))
    )
