"""The transfer table: every scenario, victim and method, in the surrogate and deployed, from the cells of a campaign.

Total CTE is averaged over the drives of a seed, then over seeds; its spread is that over seeds. A ratio to no attack is of sums, each drive
against the drive from the same start in the same domain. The transfer ratio is the deployed ratio over the surrogate's, of the seeds and
the starts that have both. Intervals resample whole seeds. What was not run is missing, and says so.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from advnerf_core.report.cells import CellResult, Drives
from advnerf_core.report.conditions import NONE
from advnerf_core.report.reference import Domain, Reference
from advnerf_core.report.statistics import (
    Interval,
    mean_and_std,
    ratio_interval,
    ratio_of_sums,
    transfer_interval,
)

DOMAINS: tuple[Domain, ...] = ("surrogate", "deployed")


@dataclass(frozen=True)
class Wanted:
    """A row that a table should have, and how many seeds.

    Attributes:
        scenario: Name of the scenario.
        placement: Name of the placement; empty for the scenario's own.
        victim: Which policy.
        method: Which search.
        seeds: Its seeds.
    """

    scenario: str
    placement: str
    victim: str
    method: str
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class TableRow:
    """One line of the table: all seeds of a scenario, victim and method in one domain. None where nothing was run.

    Attributes:
        scenario: Name of the scenario.
        placement: Name of the placement.
        victim: Which policy.
        method: Which search.
        domain: surrogate or deployed.
        seeds: Seeds that are there.
        missing: Seeds that are not.
        drives: Number of drives.
        mean_m: Mean total CTE [m].
        std_m: Its sample standard deviation over seeds [m]; None of one seed.
        ratio: Ratio to no attack in the same domain.
        ratio_interval: Its bootstrap interval over seeds.
        transfer: Deployed ratio over surrogate ratio, from the same starts; on deployed rows only.
        transfer_interval: Its interval.
        off_track: Drives that left the track.
        paper_m: The paper's mean.
        paper_std_m: The paper's standard deviation.
        paper_ratio: The paper's mean over its deployed drive without attack.
    """

    scenario: str
    placement: str
    victim: str
    method: str
    domain: Domain
    seeds: tuple[int, ...]
    missing: tuple[int, ...]
    drives: int = 0
    mean_m: float | None = None
    std_m: float | None = None
    ratio: float | None = None
    ratio_interval: Interval | None = None
    transfer: float | None = None
    transfer_interval: Interval | None = None
    off_track: int = 0
    paper_m: float | None = None
    paper_std_m: float | None = None
    paper_ratio: float | None = None

    def record(self) -> dict[str, Any]:
        """JSON-ready values."""
        return asdict(self)


@dataclass(frozen=True)
class TransferTable:
    """All lines, and the cells they came from.

    Attributes:
        rows: The lines, in the order asked for.
        cells: The cells, by name.
        name: Name of the campaign.
        reference: What it is held against.
    """

    rows: tuple[TableRow, ...]
    cells: dict[str, CellResult] = field(default_factory=dict)
    name: str = ""
    reference: Reference = field(default_factory=Reference)

    def find(
        self, scenario: str, victim: str, method: str, domain: Domain, placement: str = ""
    ) -> TableRow | None:
        """One line; None where it was not asked for."""
        key = (scenario, placement, victim, method, domain)
        return next(
            (r for r in self.rows if (r.scenario, r.placement, r.victim, r.method, r.domain) == key), None
        )

    def cells_of(self, row: TableRow) -> list[CellResult]:
        """The cells that a line sums up."""
        key = (row.scenario, row.placement, row.victim, row.method)
        return [cell for cell in self.cells.values() if _key(cell) == key]


def make_table(
    wanted: Sequence[Wanted],
    cells: Iterable[CellResult],
    name: str = "",
    reference: Reference | None = None,
) -> TransferTable:
    """Sum the cells up.

    Args:
        wanted: What the table should have; it says what is missing.
        cells: What is there; cells that were not asked for are left out.
        name: Name of the campaign.
        reference: What it is held against; None for nothing.
    """
    against = reference or Reference()
    by_name = {cell.name: cell for cell in cells}
    of_row = {_key(cell): [c for c in by_name.values() if _key(c) == _key(cell)] for cell in by_name.values()}
    rows: list[TableRow] = []
    used: dict[str, CellResult] = {}
    for want in wanted:
        found = sorted(of_row.get(_key(want), []), key=lambda cell: cell.seed)
        found = [cell for cell in found if cell.seed in want.seeds]
        used |= {cell.name: cell for cell in found}
        rows += [_row(want, found, domain, against) for domain in DOMAINS]
    return TransferTable(tuple(rows), used, name, against)


def _key(cell: CellResult | Wanted) -> tuple[str, str, str, str]:
    return cell.scenario, cell.placement, cell.victim, cell.method


def _row(want: Wanted, cells: Sequence[CellResult], domain: Domain, reference: Reference) -> TableRow:
    paper_m, paper_std_m = reference.total(want.scenario, domain, want.method)
    paper_none_m, _ = reference.total(want.scenario, "deployed", NONE)
    have = [(cell, drives) for cell in cells if (drives := drives_in(cell, domain)) is not None]
    seeds = tuple(cell.seed for cell, _ in have)
    empty = TableRow(
        want.scenario,
        want.placement,
        want.victim,
        want.method,
        domain,
        seeds,
        tuple(s for s in want.seeds if s not in seeds),
        paper_m=paper_m,
        paper_std_m=paper_std_m,
        paper_ratio=paper_m / paper_none_m if paper_m and paper_none_m else None,
    )
    if not have:
        return empty
    mean_m, std_m = mean_and_std([drives.mean_m for _, drives in have])
    sums, none_sums = _sums([(drives, None) for _, drives in have])
    transfer, its_interval = _transfer(cells) if domain == "deployed" else (None, None)
    found = {
        "drives": sum(len(drives.total_cte_m) for _, drives in have),
        "mean_m": mean_m,
        "std_m": std_m,
        "ratio": ratio_of_sums(sums, none_sums),
        "ratio_interval": ratio_interval(sums, none_sums),
        "transfer": transfer,
        "transfer_interval": its_interval,
        "off_track": sum(sum(drives.off_track) for _, drives in have),
    }
    return TableRow(**{**{name: getattr(empty, name) for name in empty.__dataclass_fields__}, **found})


def drives_in(cell: CellResult, domain: Domain) -> Drives | None:
    """The drives of a cell in a domain; None where there are none."""
    return cell.surrogate if domain == "surrogate" else cell.deployed


def _sums(drives: Sequence[tuple[Drives, int | None]]) -> tuple[list[float], list[float]]:
    """Attacked and unattacked sum of each seed, over so many of its drives, the first ones; None for all."""
    return [sum(d.total_cte_m[:n]) for d, n in drives], [sum(d.none_total_cte_m[:n]) for d, n in drives]


def _transfer(cells: Sequence[CellResult]) -> tuple[float | None, Interval | None]:
    # A live drive begins at the first of the starts that a search may have had: the others are no part of the comparison.
    both = [
        (cell.surrogate, cell.deployed, cell.shared_starts) for cell in cells if cell.deployed is not None
    ]
    surrogate, deployed = (
        _sums([(here, n) for here, _, n in both]),
        _sums([(there, n) for _, there, n in both]),
    )
    there, here = ratio_of_sums(*deployed), ratio_of_sums(*surrogate)
    if not there or not here:
        return None, None
    return there / here, transfer_interval(deployed, surrogate)
