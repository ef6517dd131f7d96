"""Registered claims about a kind of place: places and victims are sampled, and the interval is over both.

Searches of one method against one victim at one place mostly find the same optimum, so that many of them say how well the
optimiser repeats itself, not what happens at the next place. Here they are nested: a place and a victim give one value each,
the mean over searches and starts of the method's effect minus the baseline's that is strongest in the learned scene there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from advnerf_core.report.evidence.intervals import ClusteredInterval, clustered_interval
from advnerf_core.report.evidence.outcome import Outcome
from advnerf_core.report.evidence.registration import PlaceClaim
from advnerf_core.report.evidence.results import Evidence
from advnerf_core.report.reference import Domain


@dataclass(frozen=True)
class PlaceDifference:
    """What the method does at one place to one victim, minus what the baseline does there; deployed.

    Attributes:
        scenario: The place.
        baseline: The baseline that is strongest in the learned scene.
        difference_m: Difference of the mean excess |CTE| per tick [m].
        off_track_points: Difference of the shares of drives off the track [percentage points].
    """

    scenario: str
    victim: str
    baseline: str
    difference_m: float
    off_track_points: float


@dataclass(frozen=True)
class PlaceClaimRow:
    """The result of a claim.

    Attributes:
        difference_m: Mean difference of the excess |CTE| per tick, deployed [m].
        low_m: Lower end of its interval over new places and new victims [m].
        high_m: Upper end [m].
        off_track_points: Mean difference of the shares of drives off the track [percentage points].
        off_track_low: Lower end of its interval [percentage points].
        off_track_high: Upper end [percentage points].
        places: Number of places.
        victims: Number of victims.
        each: The values that the means are of.
        registered: Whether all cells were registered.
    """

    name: str
    method: str
    difference_m: float
    low_m: float
    high_m: float
    off_track_points: float
    off_track_low: float
    off_track_high: float
    places: int
    victims: int
    each: list[dict[str, Any]]
    registered: bool


def place_claim_rows(evidence: Evidence) -> list[PlaceClaimRow]:
    """All registered claims whose cells exist."""
    made = [_row(evidence, claim) for claim in evidence.registration.claims]
    return [row for row in made if row is not None]


def place_claim_data(evidence: Evidence) -> dict[str, Any]:
    """The claims as JSON data; empty without any."""
    if not evidence.registration.claims:
        return {}
    return {"claims": [vars(row) for row in place_claim_rows(evidence)]}


def _row(evidence: Evidence, claim: PlaceClaim) -> PlaceClaimRow | None:
    found = [
        [_difference(evidence, claim, scenario, victim) for victim in claim.victims]
        for scenario in claim.scenarios
    ]
    each = [one for row in found for one in row if one is not None]
    if len(each) < len(claim.scenarios) * len(claim.victims):
        return None
    shape = len(claim.scenarios), len(claim.victims)
    excess = _interval(evidence, [one.difference_m for one in each], shape)
    off = _interval(evidence, [one.off_track_points for one in each], shape)
    cells = [
        cell
        for one in each
        for method in (claim.method, one.baseline)
        for cell in evidence.searches((one.scenario, "", one.victim, method))
    ]
    return PlaceClaimRow(
        claim.name,
        claim.method,
        *(excess.mean, excess.low, excess.high),
        *(off.mean, off.low, off.high),
        *shape,
        [vars(one) for one in each],
        all(map(evidence.is_registered, cells)),
    )


def _interval(evidence: Evidence, values: list[float], shape: tuple[int, int]) -> ClusteredInterval:
    """Interval of the mean over places, which share their victims."""
    interval = clustered_interval(list(np.reshape(values, shape)), evidence.registration.level)
    assert interval is not None, "a claim has several places and victims"
    return interval


def _difference(evidence: Evidence, claim: PlaceClaim, scenario: str, victim: str) -> PlaceDifference | None:
    """The values of one place and victim; None where a method was not driven."""

    def outcomes(method: str, domain: Domain) -> list[Outcome]:
        cells = evidence.searches((scenario, "", victim, method))
        return [outcome for cell in cells for outcome in evidence.outcomes(cell, domain)]

    def excess_m(method: str, domain: Domain) -> float:
        return float(np.mean([each.excess_cte_m_per_tick for each in outcomes(method, domain)]))

    if not all(
        outcomes(method, domain)
        for method in (claim.method, *claim.against)
        for domain in ("surrogate", "deployed")
    ):
        return None
    baseline = max(claim.against, key=lambda method: excess_m(method, "surrogate"))
    shares = [
        float(np.mean([each.off_track for each in outcomes(method, "deployed")]))
        for method in (claim.method, baseline)
    ]
    return PlaceDifference(
        scenario,
        victim,
        baseline,
        excess_m(claim.method, "deployed") - excess_m(baseline, "deployed"),
        100.0 * (shares[0] - shares[1]),
    )
