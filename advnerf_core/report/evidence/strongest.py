"""The best random search of a published set: what an attacker without a gradient reaches, who takes the maximum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from advnerf_core.driving.metrics import mean_cte_limit_m
from advnerf_core.report.cells import read_cell
from advnerf_core.report.conditions import CONTROLS, style_of
from advnerf_core.report.evidence.families import COARSE_SEARCHES, RANDOM_FAMILIES
from advnerf_core.report.evidence.outcome import Outcome
from advnerf_core.report.evidence.registration import read_registration
from advnerf_core.report.evidence.results import Evidence, Key


@dataclass(frozen=True)
class Strongest:
    """The search without a gradient that moves a victim most where it is deployed, of one scenario.

    Attributes:
        place: Scenario and placement, as readers see them.
        victim: Name of the victim.
        method: Method of the search.
        searches: Searches of this method.
        evaluations: Textures that each of them tried.
        surrogate_m: Excess of the best search in the learned scene, mean over its starts [m per tick].
        deployed_m: The same where it is deployed [m per tick].
        off_track: Deployed drives of that search that left the track.
        drives: Deployed drives of that search.
        mean_m: Deployed excess, mean over all searches of the method [m per tick].
        all_off_track: Deployed drives of all searches of the method that left the track.
        all_drives: Deployed drives of all searches of the method.
        margin_m: What a victim that is called hardened may be moved [m per tick].
    """

    place: str
    victim: str
    method: str
    searches: int
    evaluations: int
    surrogate_m: float
    deployed_m: float
    off_track: int
    drives: int
    mean_m: float
    all_off_track: int
    all_drives: int
    margin_m: float

    @property
    def text(self) -> str:
        """All of it, in words."""
        return (
            f"{style_of(self.method).title}, best of {self.searches} searches with {self.evaluations} textures each: {self.surrogate_m:.3f} m per tick in "
            f"the learned scene, {self.deployed_m:.3f} m deployed, {self.off_track} of {self.drives} drives off the track; mean of the searches "
            f"{self.mean_m:.3f} m deployed, {self.all_off_track} of {self.all_drives} off the track"
        )


def strongest_random(folder: Path) -> list[Strongest]:
    """The best search without a gradient of every scenario of a published set; none where none was deployed.

    Args:
        folder: Of the set.
    """
    registration = read_registration(folder)
    if registration is None:
        return []
    wanted = {*RANDOM_FAMILIES, *COARSE_SEARCHES, *CONTROLS}
    cells = [cell for file in sorted(folder.glob("*.json")) if (cell := read_cell(file)).method in wanted]
    evidence = Evidence(registration, cells)
    by_place: dict[tuple[str, str, str], list[str]] = {}
    for cell in evidence.cells.values():
        if cell.method not in CONTROLS and cell.kept.get("deployed") and evidence.without(cell):
            by_place.setdefault((cell.scenario, cell.placement, cell.victim), []).append(cell.method)
    found = [
        [_of_method(evidence, (*place, method)) for method in dict.fromkeys(methods)]
        for place, methods in by_place.items()
    ]
    return [max(each, key=lambda strongest: strongest.deployed_m) for each in found]


def _of_method(evidence: Evidence, key: Key) -> Strongest:
    searches = [cell for cell in evidence.searches(key) if cell.kept.get("deployed")]
    outcomes = [evidence.outcomes(cell, "deployed") for cell in searches]
    means = [_mean_m(each) for each in outcomes]
    best = int(np.argmax(means))
    scenario = evidence.scenario_of(searches[best])
    return Strongest(
        f"{key[0]} {key[1]}".strip().replace("_", " "),
        key[2],
        key[3],
        len(searches),
        scenario.evaluations,
        _mean_m(evidence.outcomes(searches[best], "surrogate")),
        means[best],
        _off(outcomes[best]),
        len(outcomes[best]),
        float(np.mean(means)),
        sum(map(_off, outcomes)),
        sum(map(len, outcomes)),
        0.5 * mean_cte_limit_m(scenario.off_track_m),
    )


def _mean_m(outcomes: Sequence[Outcome]) -> float:
    return float(np.mean([each.excess_cte_m_per_tick for each in outcomes]))


def _off(outcomes: Sequence[Outcome]) -> int:
    return sum(each.off_track for each in outcomes)
