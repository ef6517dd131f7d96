"""A row of results: a method against a victim in one domain, in metres per tick over both controls, with intervals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from advnerf_core.driving.metrics import DriveMetrics, Horizon
from advnerf_core.report.cells import CellResult, cell_name
from advnerf_core.report.conditions import EMPTY, NONE
from advnerf_core.report.evidence.intervals import LEVEL, ClusteredInterval, clustered_interval
from advnerf_core.report.reference import Domain

Key = tuple[str, str, str]  # scenario, victim, method


@dataclass(frozen=True)
class RowOf:
    """What a row is of: a method, or ``none``, against a victim in one domain."""

    scenario: str
    victim: str
    method: str
    domain: Domain

    @property
    def key(self) -> Key:
        """Scenario, victim and method."""
        return self.scenario, self.victim, self.method


@dataclass(frozen=True)
class Row(RowOf):
    """One method against one victim in one domain, over its searches and their starts.

    Attributes:
        excess_m: Mean excess |CTE| per tick over the plain object [m]; for ``none`` its mean |CTE|.
        low_m: Lower end of its interval [m]; None with too few drives.
        high_m: Upper end [m].
        over_no_object_m: Mean excess over no object [m]; None without such drives, and for these drives themselves.
        over_no_object_low_m: Lower end of its interval [m].
        over_no_object_high_m: Upper end [m].
        over: Population of the interval.
        off_track: Drives that left the track.
        collided: Drives that ended in a collision, by obstacle.
        off_lane_share: Share of all ticks off the track; None if only totals are stored.
        leaving_s: Median time to leaving the track, over the drives that left it [s].
        registered: Whether all its cells were registered; else it is exploration.
    """

    searches: int
    drives: int
    excess_m: float
    low_m: float | None
    high_m: float | None
    over_no_object_m: float | None
    over_no_object_low_m: float | None
    over_no_object_high_m: float | None
    over: str
    off_track: int
    collided: dict[str, int]
    off_lane_share: float | None
    leaving_s: float | None
    registered: bool


@dataclass(frozen=True)
class Outcome:
    """Effect of an attack on one drive.

    Attributes:
        excess_cte_m_per_tick: Mean |CTE| of the attacked drive minus that of the control's drive from the same start [m].
        off_track: Whether |CTE| of the attacked drive ever exceeded the off-track limit.
        collided_with: Name of the obstacle that the attacked car hit; None without a collision.
        time_to_leaving_s: Time of the first tick off the track [s]; None if the car never left it, or if only totals are stored.
        share_off_lane: Share of the ticks off the track, within 0..1; None if only totals are stored.
    """

    excess_cte_m_per_tick: float
    off_track: bool
    collided_with: str | None
    time_to_leaving_s: float | None
    share_off_lane: float | None

    @classmethod
    def of(
        cls, attacked: DriveMetrics, control: DriveMetrics, horizon: Horizon, collided_with: str | None
    ) -> Outcome:
        """Compare an attacked drive with the control's drive from the same start, both measured over the horizon."""
        return cls(
            (attacked.total_cte_m - control.total_cte_m) / horizon.ticks,
            attacked.off_track,
            collided_with,
            attacked.time_to_leaving_s,
            float((np.abs(attacked.ctes_m) > horizon.off_track_m).mean()),
        )


class CellDrives:
    """Outcomes of the drives of cells, from their stored totals. `Evidence` computes them from published poses."""

    level = LEVEL

    def __init__(self, cells: Iterable[CellResult]) -> None:
        self.cells = {cell.name: cell for cell in cells}

    def searches(self, key: Key) -> list[CellResult]:
        """The cells of one method against one victim, by seed."""
        return sorted((cell for cell in self.cells.values() if cell.key == key), key=lambda cell: cell.seed)

    def without(self, cell: CellResult, control: str = NONE) -> CellResult | None:
        """The cell of the same drives with a control: the plain object (``none``) or no object (``empty``)."""
        return self.cells.get(cell_name(cell.scenario, cell.victim, control, 0))

    def is_registered(self, cell: CellResult) -> bool:
        """Whether a cell was registered."""
        return False

    def has(self, cell: CellResult, domain: Domain) -> bool:
        """Whether a cell was driven in a domain."""
        return cell.drives(domain) is not None

    def share_starts(self, cells: Sequence[CellResult], domain: Domain) -> bool:
        """Whether the drives of all cells begin at the same starts; then they share the drives without attack."""
        return len({driven.none_total_cte_m for cell in cells if (driven := cell.drives(domain))}) == 1

    def mean_ctes_m(self, cell: CellResult, domain: Domain) -> list[float]:
        """Mean |CTE| of each drive of a cell [m]; empty if the number of ticks is unknown."""
        driven = cell.drives(domain)
        return [total / cell.ticks for total in driven.total_cte_m] if driven and cell.ticks else []

    def outcomes(self, cell: CellResult, domain: Domain, control: str = NONE) -> list[Outcome]:
        """Outcomes of the drives of a cell, each against the control's drive from the same start; empty without such drives."""
        driven, clean = cell.drives(domain), self.without(cell, control)
        against = clean.drives(domain) if clean else None
        if driven is None or not cell.ticks or (control != NONE and against is None):
            return []
        # A cell contains its drives past the plain object.
        totals_m = driven.none_total_cte_m if control == NONE or against is None else against.total_cte_m
        return [
            Outcome((attacked - other) / cell.ticks, off_track, hit, None, None)
            for attacked, other, off_track, hit in zip(
                driven.total_cte_m, totals_m, driven.off_track, cell.obstacles(domain), strict=False
            )
        ]

    def excesses_m(self, cell: CellResult, domain: Domain, control: str = NONE) -> list[float]:
        """Excess |CTE| per tick of each drive of a cell over the control [m], in the order of the starts."""
        return [outcome.excess_cte_m_per_tick for outcome in self.outcomes(cell, domain, control)]


def make_row(drives: CellDrives, key: Key, domain: Domain) -> Row | None:
    """The row of one method against one victim; None if it has no drives, or no drives to compare with."""
    cells = [cell for cell in drives.searches(key) if drives.has(cell, domain)]
    outcomes = [drives.outcomes(cell, domain) for cell in cells]
    if not cells or not all(outcomes):
        return None
    # The excess of the plain object over itself is zero: its row shows what the other rows exceed.
    values = [
        drives.mean_ctes_m(cell, domain) if cell.method == NONE else drives.excesses_m(cell, domain)
        for cell in cells
    ]
    shared = drives.share_starts(cells, domain)
    interval = _interval(drives, values, shared)
    bare = _over_no_object_m(drives, cells, domain)
    bare_interval = _interval(drives, bare, shared) if bare else None
    flat = [outcome for found in outcomes for outcome in found]
    leaving = [outcome.time_to_leaving_s for outcome in flat if outcome.time_to_leaving_s is not None]
    shares = [outcome.share_off_lane for outcome in flat if outcome.share_off_lane is not None]
    return Row(
        *key,
        domain,
        searches=len(cells),
        drives=len(flat),
        excess_m=_mean(values),
        low_m=interval.low if interval else None,
        high_m=interval.high if interval else None,
        over_no_object_m=_mean(bare) if bare else None,
        over_no_object_low_m=bare_interval.low if bare_interval else None,
        over_no_object_high_m=bare_interval.high if bare_interval else None,
        over=interval.over if interval else "",
        off_track=sum(outcome.off_track for outcome in flat),
        collided=dict(sorted(Counter(filter(None, (outcome.collided_with for outcome in flat))).items())),
        off_lane_share=float(np.mean(shares)) if shares else None,
        leaving_s=float(np.median(leaving)) if leaving else None,
        registered=all(drives.is_registered(cell) for cell in cells),
    )


def _over_no_object_m(drives: CellDrives, cells: Sequence[CellResult], domain: Domain) -> list[list[float]]:
    """Excess of each drive over no object, by cell; empty if a cell has no drives to compare with, or is the control itself."""
    found = [drives.excesses_m(cell, domain, EMPTY) for cell in cells if cell.method != EMPTY]
    return found if all(found) else []


def _mean(values: Sequence[Sequence[float]]) -> float:
    return float(np.mean([np.mean(each) for each in values]))


def _interval(
    drives: CellDrives, values: Sequence[Sequence[float]], shared: bool
) -> ClusteredInterval | None:
    return clustered_interval(values, drives.level, shared and len({len(each) for each in values}) == 1)
