"""Registered contrasts: the same attacks under two conditions, drive by drive, which isolate the effect of one difference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from advnerf_core.report.conditions import CONTROLS
from advnerf_core.report.evidence.intervals import clustered_interval
from advnerf_core.report.evidence.registration import Contrast
from advnerf_core.report.evidence.results import Evidence


@dataclass(frozen=True)
class ContrastRow:
    """One contrast of one method against one victim.

    Attributes:
        before: Scenario with the first condition.
        after: Scenario with the second one.
        before_m: Mean excess |CTE| per tick under the first condition [m].
        after_m: The same under the second, over the same searches and starts [m].
        difference_m: After minus before, paired by search and start [m].
        low_m: Lower end of its interval [m]; None with too few drives.
        high_m: Upper end [m].
        searches: Searches whose attack was driven under both conditions.
        other_attacks: Searches that found another attack under the second condition, which are left out.
        drives: Pairs of drives.
        registered: Whether all cells were registered; else it is exploration.
    """

    name: str
    before: str
    after: str
    victim: str
    method: str
    before_m: float
    after_m: float
    difference_m: float
    low_m: float | None
    high_m: float | None
    searches: int
    other_attacks: int
    drives: int
    registered: bool


def contrast_rows(evidence: Evidence) -> list[ContrastRow]:
    """All registered contrasts, for each victim and method with attacks that were driven under both conditions."""
    found = []
    for contrast in evidence.registration.contrasts:
        keys = dict.fromkeys(
            (cell.victim, cell.method)
            for cell in evidence.registration.cells
            if cell.scenario == contrast.after and cell.method not in CONTROLS
        )
        found += [
            row for victim, method in keys if (row := _row(evidence, contrast, victim, method)) is not None
        ]
    return found


def contrast_data(evidence: Evidence) -> dict[str, Any]:
    """The contrasts as JSON data; empty without any."""
    if not evidence.registration.contrasts:
        return {}
    return {"contrasts": [vars(row) for row in contrast_rows(evidence)]}


def _row(evidence: Evidence, contrast: Contrast, victim: str, method: str) -> ContrastRow | None:
    before, after = (
        {cell.seed: cell for cell in evidence.searches((scenario, victim, method))}
        for scenario in (contrast.before, contrast.after)
    )
    found = [(before[seed], after[seed]) for seed in sorted(before.keys() & after.keys())]
    # Another attack under the second condition would add a second difference.
    pairs = [(one, other) for one, other in found if one.attack_id == other.attack_id]
    if not pairs:
        return None
    values = [
        [evidence.excesses_m(one, contrast.before_in), evidence.excesses_m(other, contrast.after_in)]
        for one, other in pairs
    ]
    drives = min(len(each) for pair in values for each in pair)
    if not drives:
        return None
    first, second = np.array([[each[:drives] for each in pair] for pair in values]).transpose(1, 0, 2)
    interval = clustered_interval(list(second - first), evidence.registration.level)
    return ContrastRow(
        contrast.name,
        contrast.before,
        contrast.after,
        victim,
        method,
        before_m=float(first.mean()),
        after_m=float(second.mean()),
        difference_m=float((second - first).mean()),
        low_m=interval.low if interval else None,
        high_m=interval.high if interval else None,
        searches=len(pairs),
        other_attacks=len(found) - len(pairs),
        drives=second.size,
        registered=all(evidence.is_registered(cell) for pair in pairs for cell in pair),
    )
