"""Registered claims about a kind of place: places and victims are sampled, and the interval is over both; at one place, over victims.

Searches of one method against one victim at one place mostly find the same optimum, so that many of them say how well the
optimiser repeats itself, not what happens at the next place. Here they are nested: a place and a victim give one value each,
the mean over searches and starts of the method's effect minus the baseline's that is strongest in the learned scene there.
How often such intervals cover is measured by ``benchmarks/coverage.py``, with places for searches and victims for starts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from advnerf_core.report.cells import CellResult
from advnerf_core.report.evidence.intervals import clustered_interval
from advnerf_core.report.evidence.registration import PlaceClaim
from advnerf_core.report.evidence.results import Evidence, mean_excess_m
from advnerf_core.report.reference import DOMAINS, Domain


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
        difference_m: Mean difference of the excess |CTE| per tick, deployed [m]; None if it cannot be made.
        low_m: Lower end of its interval over new places, if there are several, and new victims [m].
        high_m: Upper end [m].
        off_track_points: Mean difference of the shares of drives off the track [percentage points].
        low_off_track_points: Lower end of its interval over new places and new victims, at least -100; None if all are equal, as values
            without spread give no interval.
        least_off_track_points: The smallest of these differences.
        places: Number of places.
        victims: Number of victims.
        each: The values that the means are of.
        reason: Reason for a claim that cannot be made.
    """

    name: str
    method: str
    places: int
    victims: int
    difference_m: float | None = None
    low_m: float | None = None
    high_m: float | None = None
    off_track_points: float | None = None
    low_off_track_points: float | None = None
    least_off_track_points: float | None = None
    each: tuple[dict[str, Any], ...] = ()
    reason: str = ""


def place_claim_data(evidence: Evidence) -> dict[str, Any]:
    """The claims as JSON data; empty without any. One that cannot be made is there, with the reason."""
    claims = evidence.registration.claims
    return {"claims": [vars(place_claim_row(evidence, claim)) for claim in claims]} if claims else {}


def place_claim_row(evidence: Evidence, claim: PlaceClaim) -> PlaceClaimRow:
    """The result of one registered claim, from all registered searches of its methods."""
    shape = len(claim.scenarios), len(claim.victims)
    if missing := _missing(evidence, claim):
        return PlaceClaimRow(
            claim.name, claim.method, *shape, reason=f"{missing} was not driven as registered"
        )
    each = [
        _difference(evidence, claim, scenario, victim)
        for scenario in claim.scenarios
        for victim in claim.victims
    ]
    values_m, points = (
        np.reshape([getattr(one, name) for one in each], shape)
        for name in ("difference_m", "off_track_points")
    )
    interval, of_points = (
        clustered_interval(list(values), evidence.registration.level) for values in (values_m, points)
    )
    assert interval is not None, "a claim has several victims"
    assert of_points is not None, "a claim has several victims"
    return PlaceClaimRow(
        claim.name,
        claim.method,
        *shape,
        *(interval.mean, interval.low, interval.high),
        *(of_points.mean, max(of_points.low, -100.0) if np.ptp(points) else None, float(points.min())),
        each=tuple(vars(one) for one in each),
    )


def _missing(evidence: Evidence, claim: PlaceClaim) -> str:
    """A registered search of the claim's methods that was not driven in both domains; empty if all were."""
    methods = (claim.method, *claim.against)
    for registered in evidence.registration.cells:
        wanted = registered.scenario in claim.scenarios and registered.victim in claim.victims
        if not wanted or registered.method not in methods:
            continue
        cell = evidence.cells.get(registered.name)
        if cell is None or not evidence.is_registered(cell):
            return registered.name
        if not all(evidence.outcomes(cell, domain) for domain in DOMAINS):
            return registered.name
    return ""


def _difference(evidence: Evidence, claim: PlaceClaim, scenario: str, victim: str) -> PlaceDifference:
    """The values of one place and victim."""

    def searches(method: str) -> list[CellResult]:
        found = evidence.searches((scenario, victim, method))
        return [cell for cell in found if evidence.is_registered(cell)]

    def excess_m(method: str, domain: Domain) -> float:
        return float(np.mean([mean_excess_m(evidence, cell, domain) for cell in searches(method)]))

    def off_track(method: str) -> float:
        drives = [drive for cell in searches(method) for drive in evidence.outcomes(cell, "deployed")]
        return float(np.mean([drive.off_track for drive in drives]))

    baseline = max(claim.against, key=lambda method: excess_m(method, "surrogate"))
    return PlaceDifference(
        scenario,
        victim,
        baseline,
        excess_m(claim.method, "deployed") - excess_m(baseline, "deployed"),
        100.0 * (off_track(claim.method) - off_track(baseline)),
    )
