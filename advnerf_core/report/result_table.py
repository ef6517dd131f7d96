"""The table of results: every scenario, victim and method, in the surrogate and deployed, from finished cells.

A row has totals and the excess in metres over both controls; `evidence.rows` computes it as for published sets. Missing runs are
named as missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from advnerf_core.report.cells import CellResult
from advnerf_core.report.evidence.rows import CellDrives, Key, Row, RowOf, make_row
from advnerf_core.report.reference import DOMAINS, Domain


@dataclass(frozen=True)
class TableRow(RowOf):
    """One line of the table: all seeds of a scenario, victim and method in one domain. None for missing values.

    Attributes:
        off_track: Drives that left the track.
        total_m: Mean total CTE [m].
        total_std_m: Standard deviation over seeds of their mean totals [m]; None for one seed.
        plain_total_m: Mean total CTE from the same starts past the plain object [m].
        ticks: Control ticks of a drive; 0 if the cells do not store it.
        excess: Excess per tick over both controls; None if the ticks are unknown.
    """

    seeds: tuple[int, ...]
    missing: tuple[int, ...]
    drives: int = 0
    off_track: int = 0
    total_m: float | None = None
    total_std_m: float | None = None
    plain_total_m: float | None = None
    ticks: int = 0
    excess: Row | None = None

    @property
    def ratio(self) -> float | None:
        """Total CTE divided by the total past the plain object."""
        return self.total_m / self.plain_total_m if self.total_m is not None and self.plain_total_m else None

    @property
    def mean_abs_cte_m(self) -> float | None:
        """Mean |CTE| per tick [m]."""
        return self.total_m / self.ticks if self.total_m is not None and self.ticks else None

    def record(self) -> dict[str, Any]:
        """JSON-ready values, including the excess."""
        own = {name: value for name, value in asdict(self).items() if name != "excess"}
        excess = vars(self.excess) if self.excess else dict.fromkeys(Row.__dataclass_fields__)
        return {**excess, **own}


@dataclass(frozen=True)
class ResultTable:
    """All lines in the requested order, and their cells by name."""

    rows: tuple[TableRow, ...]
    cells: dict[str, CellResult] = field(default_factory=dict)
    name: str = ""

    def find(self, scenario: str, victim: str, method: str, domain: Domain) -> TableRow | None:
        """One line; None if it was not requested."""
        key = (scenario, victim, method)
        return next((row for row in self.rows if row.key == key and row.domain == domain), None)


def make_table(
    wanted: Mapping[Key, Sequence[int]],
    cells: Iterable[CellResult],
    name: str = "",
    domains: Sequence[Domain] = DOMAINS,
) -> ResultTable:
    """Summarise cells as one row per domain of each wanted key: missing seeds are named, and cells that were not requested are left out."""
    drives = CellDrives(cell for cell in cells if cell.seed in wanted.get(cell.key, ()))
    rows = tuple(_row(key, seeds, drives, domain) for key, seeds in wanted.items() for domain in domains)
    return ResultTable(rows, drives.cells, name)


def _row(key: Key, wanted: Sequence[int], drives: CellDrives, domain: Domain) -> TableRow:
    found = [(cell, driven) for cell in drives.searches(key) if (driven := cell.drives(domain))]
    seeds = tuple(cell.seed for cell, _ in found)
    missing = tuple(seed for seed in wanted if seed not in seeds)
    row = TableRow(*key, domain, seeds, missing)
    if not found:
        return row
    totals = [total for _, driven in found for total in driven.total_cte_m]
    by_seed = [driven.mean_m for _, driven in found]
    return replace(
        row,
        drives=len(totals),
        off_track=sum(sum(driven.off_track) for _, driven in found),
        total_m=float(np.mean(totals)),
        total_std_m=float(np.std(by_seed, ddof=1)) if len(by_seed) > 1 else None,
        plain_total_m=float(np.mean([total for _, driven in found for total in driven.none_total_cte_m])),
        ticks=found[0][0].ticks,
        excess=make_row(drives, key, domain),
    )
