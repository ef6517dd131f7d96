"""What the transfer table must show, and whether it does. A target whose cells are missing is neither met nor missed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from advnerf_core.report.reference import Limit, Measure
from advnerf_core.report.transfer import Domain, TableRow, TransferTable

VICTIM = "hardened"


def _relative_spread(row: TableRow) -> float | None:
    return row.std_m / row.mean_m if row.std_m is not None and row.mean_m else None


# What each measure is called, and how it is read off a line.
_MEASURES: Mapping[Measure, tuple[str, Callable[[TableRow], float | None]]] = {
    "ratio": ("ratio to no attack", lambda row: row.ratio),
    "spread": ("std / mean", _relative_spread),
    "off_track": ("drives off the track", lambda row: float(row.off_track)),
    "off_track_share": ("share of drives off the track", lambda row: row.off_track / row.drives),
}


@dataclass(frozen=True)
class TableTarget:
    """One target.

    Attributes:
        scenario: Which scenario.
        method: Which method.
        domain: Where.
        what: What is measured.
        target: What must be reached, in words.
        value: What was measured of the seeds that are there; None where nothing was.
        met: Whether it was; None where it is not known, as seeds are missing.
        seeds: Of how many seeds.
        short_by: How much is lacking, as a share of the target; 0 where it is met.
        victim: Whose line is held against it.
    """

    scenario: str
    method: str
    domain: Domain
    what: str
    target: str
    value: float | None
    met: bool | None
    seeds: int
    short_by: float = 0.0
    victim: str = VICTIM

    @property
    def verdict(self) -> str:
        """In words."""
        if self.met is None:
            return "not measured" if self.value is None else f"{self.seeds} seed(s) so far"
        return "met" if self.met else f"missed by {100 * self.short_by:.0f} %"

    def record(self) -> dict[str, Any]:
        """JSON-ready values."""
        return {**asdict(self), "verdict": self.verdict}


def table_targets(table: TransferTable) -> list[TableTarget]:
    """The targets of all lines that the table has, of its reference."""
    found = [
        _target(table, scenario, limit)
        for scenario, limits in table.reference.targets.items()
        for limit in limits
        if table.find(scenario, limit.victim, limit.method, limit.domain) is not None
    ]
    return found


def _target(table: TransferTable, scenario: str, limit: Limit) -> TableTarget:
    what, of = _MEASURES[limit.of]
    row = table.find(scenario, limit.victim, limit.method, limit.domain)
    value = of(row) if row is not None and row.seeds else None
    if limit.above:
        said, met, short = _against(table, scenario, limit, row, value, of)
    elif limit.at_least is not None:
        said = f">= {limit.at_least:g}"
        met, short = _verdict(row, value, limit.at_least, at_least=True)
    else:
        assert limit.at_most is not None, "a limit has one bound"
        said = f"<= {limit.at_most:g}"
        met, short = _verdict(row, value, limit.at_most, at_least=False)
    seeds = len(row.seeds) if row else 0
    words = limit.said or said
    return TableTarget(
        scenario, limit.method, limit.domain, what, words, value, met, seeds, short, limit.victim
    )


def _against(
    table: TransferTable,
    scenario: str,
    limit: Limit,
    row: TableRow | None,
    value: float | None,
    of: Callable[[TableRow], float | None],
) -> tuple[str, bool | None, float]:
    """The limit that another method sets: in words, whether it is exceeded, and what is lacking."""
    other = table.find(scenario, limit.victim, limit.above, limit.domain)
    bound = of(other) if other is not None and other.seeds else None
    if bound is None or other is None or other.missing:
        met, short = None, 0.0
    else:
        met, short = _verdict(row, value, bound, at_least=True)
    if met and value == bound:  # as good as the other is not better
        met = False
    return f"> {limit.above}" if bound is None else f"> {limit.above} {bound:.2f}", met, short


def _verdict(
    row: TableRow | None, value: float | None, limit: float, at_least: bool
) -> tuple[bool | None, float]:
    """Whether a limit is kept, None while seeds are missing, and what is lacking as a share of it."""
    if row is None or row.missing or value is None:
        return None, 0.0
    lacking = limit - value if at_least else value - limit
    # Of a limit of zero any excess counts by its own size.
    return lacking <= 0.0, max(lacking, 0.0) / (limit or 1.0)
