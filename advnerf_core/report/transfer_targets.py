"""What the transfer table must show, and whether it does. A target whose cells are missing is neither met nor missed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from advnerf_core.report.transfer import Domain, TableRow, TransferTable

# Ratio to no attack in the same domain: at least, for gradient attacks, in the surrogate and deployed.
AT_LEAST: dict[str, tuple[float, float]] = {
    "straight": (2.5, 2.0), "right": (3.5, 2.5), "left": (3.5, 2.5), "green_screen": (4.0, 5.2), "monitor": (4.0, 3.5),
}  # fmt: skip
RANDOM_AT_MOST = 1.2
# Deployed gradient attacks of the other campaigns: meshes by their textures and shapes; places and colours must beat random ones.
MESHES_AT_LEAST = {
    "straight_texture": 1.41, "right_texture": 1.31, "left_texture": 2.35,
    "straight_shape_1m": 10.0, "straight_shape_05m": 10.0, "straight_balls_05m": 10.0,
}  # fmt: skip
PLACES = ("straight_places", "right_places", "left_places")
LIVE = ("green_screen", "monitor")
_SPREAD, _LEFT_SHARE = 0.25, 0.8
VICTIM, RETRAINED = "hardened", "retrained"


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


def table_targets(table: TransferTable, victim: str = VICTIM) -> list[TableTarget]:
    """The targets of all lines that the table has.

    Args:
        table: The table.
        victim: Whose lines are held against the targets: the one for whom random textures are a fair baseline.
    """
    present = {row.scenario for row in table.rows}
    found = []
    for scenario, (here, there) in AT_LEAST.items():
        if scenario not in present:
            continue
        gradient = {
            domain: table.find(scenario, victim, "gradient", domain) for domain in ("surrogate", "deployed")
        }
        found += [
            _at_least(scenario, "gradient", "surrogate", gradient["surrogate"], here),
            _at_least(scenario, "gradient", "deployed", gradient["deployed"], there),
        ]
        if scenario == "green_screen":
            found.append(
                _limit(scenario, "gradient", "std / mean", _SPREAD, gradient["deployed"], _relative_spread)
            )
        if scenario == "monitor":
            found.append(_left_often(scenario, gradient["deployed"]))
        random = table.find(scenario, victim, "random", "deployed")
        found.append(
            _limit(scenario, "random", "ratio to no attack", RANDOM_AT_MOST, random, lambda row: row.ratio)
        )
        if scenario in LIVE:
            found.append(
                _limit(
                    scenario, "random", "drives off the track", 0.0, random, lambda row: float(row.off_track)
                )
            )
    meshes = [(name, limit) for name, limit in MESHES_AT_LEAST.items() if name in present]
    found += [
        _at_least(name, "gradient", "deployed", table.find(name, victim, "gradient", "deployed"), limit)
        for name, limit in meshes
    ]
    found += [_beats_random(table, name) for name in PLACES if name in present]
    return [
        each for each in found if table.find(each.scenario, each.victim, each.method, each.domain) is not None
    ]


def _value(row: TableRow | None, of: Callable[[TableRow], float | None]) -> float | None:
    return of(row) if row is not None and row.seeds else None


def _verdict(
    row: TableRow | None, value: float | None, limit: float, at_least: bool
) -> tuple[bool | None, float]:
    """Whether a limit is kept, None while seeds are missing, and what is lacking as a share of it."""
    if row is None or row.missing or value is None:
        return None, 0.0
    lacking = limit - value if at_least else value - limit
    # Of a limit of zero any excess counts by its own size.
    return lacking <= 0.0, max(lacking, 0.0) / (limit or 1.0)


def _at_least(scenario: str, method: str, domain: Domain, row: TableRow | None, limit: float) -> TableTarget:
    value = _value(row, lambda r: r.ratio)
    met, short = _verdict(row, value, limit, at_least=True)
    seeds = len(row.seeds) if row else 0
    return TableTarget(
        scenario, method, domain, "ratio to no attack", f">= {limit:g}", value, met, seeds, short
    )


def _beats_random(table: TransferTable, scenario: str) -> TableTarget:
    """The gradient's ratio above that of as many random places and colours, on the retrained victim."""
    row, random = (table.find(scenario, RETRAINED, method, "deployed") for method in ("gradient", "random"))
    value, limit = (_value(each, lambda r: r.ratio) for each in (row, random))
    met, short = (
        (None, 0.0)
        if limit is None or random is None or random.missing
        else _verdict(row, value, limit, at_least=True)
    )
    if met and value == limit:  # as good as random is not better
        met = False
    target = "> random" if limit is None else f"> random {limit:.2f}"
    seeds = len(row.seeds) if row else 0
    return TableTarget(
        scenario, "gradient", "deployed", "ratio to no attack", target, value, met, seeds, short, RETRAINED
    )


def _limit(
    scenario: str,
    method: str,
    what: str,
    limit: float,
    row: TableRow | None,
    of: Callable[[TableRow], float | None],
) -> TableTarget:
    value = _value(row, of)
    met, short = _verdict(row, value, limit, at_least=False)
    seeds = len(row.seeds) if row else 0
    return TableTarget(scenario, method, "deployed", what, f"<= {limit:g}", value, met, seeds, short)


def _relative_spread(row: TableRow) -> float | None:
    return row.std_m / row.mean_m if row.std_m is not None and row.mean_m else None


def _left_often(scenario: str, row: TableRow | None) -> TableTarget:
    value = _value(row, lambda r: r.off_track / r.drives)
    met, short = _verdict(row, value, _LEFT_SHARE, at_least=True)
    seeds = len(row.seeds) if row else 0
    return TableTarget(
        scenario,
        "gradient",
        "deployed",
        "share of drives off the track",
        ">= 4 of 5",
        value,
        met,
        seeds,
        short,
    )
