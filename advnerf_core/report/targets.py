"""Targets: the limit, the measured value, and whether it was met. Nothing is rounded in our favour."""

# ruff: noqa: RUF001 (typography for readers: multiplication signs and dashes)

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from advnerf_core.report.conditions import style_of
from advnerf_core.report.evidence.words import collisions
from advnerf_core.report.reference import Limit
from advnerf_core.report.result_table import ResultTable, TableRow
from advnerf_core.report.text_table import Table, count, number


@dataclass(frozen=True)
class Target:
    """A limit and the measured value.

    Attributes:
        target: The limit, as text.
        value: The measured value; None without one.
        met: Whether the limit is kept; None without a measurement, or if seeds are missing.
        verdict: The answer as text.
    """

    what: str
    target: str
    value: float | None
    measured: str
    met: bool | None
    verdict: str
    paper: str


@dataclass(frozen=True)
class _Measure:
    """Title and format of a measure."""

    title: str
    digits: int
    unit: str = ""
    of_row: Callable[[TableRow], float | None] = lambda row: None


_MEASURES: Mapping[str, _Measure] = {
    "excess_m": _Measure("excess per tick", 3, " m", lambda row: row.excess.excess_m if row.excess else None),
    "ratio": _Measure("total CTE", 2, " × plain object", lambda row: row.ratio),
    "mean_abs_cte_m": _Measure("mean |CTE|", 3, " m", lambda row: row.mean_abs_cte_m),
    "off_track": _Measure("drives off the track", 0, " drives", lambda row: float(row.off_track)),
    "off_track_share": _Measure(
        "share of drives off the track", 2, " of the drives", lambda row: row.off_track / row.drives
    ),
    "laps": _Measure("laps", 0, " laps"),
    "laps_mean_abs_cte_m": _Measure("mean |CTE| of the laps", 3, " m"),
    "laps_off_track": _Measure("laps off the track", 0, " drives"),
    "latency_p99_ms": _Measure("latency, p99", 1, " ms"),
    "missed_ticks": _Measure("missed ticks", 0, " ticks"),
    "psnr_full_db": _Measure("PSNR of the camera's image", 1, " dB"),
    "psnr_policy_db": _Measure("PSNR of the policy's image", 1, " dB"),
    "steering_difference_rad": _Measure("steering difference", 4, " rad"),
}


def evaluate(
    limits: Iterable[Limit],
    table: ResultTable,
    measured: Mapping[str, float | None] | None = None,
) -> list[Target]:
    """The targets of some limits; those on rows that the table does not have are left out.

    Further measured values are given by measure; None leaves their limits out.
    """
    found = []
    for limit in limits:
        if not limit.of_drives:
            if measured is not None:
                found.append(_target(limit, measured.get(limit.of), limit.at_least, complete=True))
        elif (row := _row(table, limit, limit.method)) is not None:
            value, other = _value(row, limit), _row(table, limit, limit.above)
            bound = limit.at_least if other is None else _value(other, limit)
            complete = not row.missing and (other is None or not other.missing)
            found.append(_target(limit, value, bound, complete, row))
    return found


def _row(table: ResultTable, limit: Limit, method: str) -> TableRow | None:
    scenario = limit.scenario or next((row.scenario for row in table.rows), "")
    return table.find(scenario, limit.victim, method, limit.domain)


def _value(row: TableRow, limit: Limit) -> float | None:
    return _MEASURES[limit.of].of_row(row) if row.seeds else None


def _target(
    limit: Limit, value: float | None, lower: float | None, complete: bool, row: TableRow | None = None
) -> Target:
    measure = _MEASURES[limit.of]
    bound = lower if limit.at_most is None else limit.at_most
    if value is None or bound is None or not complete:
        met, short = None, 0.0
    else:
        lacking = value - bound if limit.at_most is not None else bound - value
        # A method as good as the one that it must exceed does not exceed it.
        met = lacking < 0.0 if limit.above else lacking <= 0.0
        short = max(lacking, 0.0) / (bound or 1.0)  # of a limit of zero any excess counts by its own size
    if met is None:
        verdict = "not measured" if value is None else f"{len(row.seeds) if row else 0} seed(s) so far"
    else:
        verdict = "met" if met else f"missed by {100 * short:.0f} %"
    text = "not measured in this run" if value is None else number(value, measure.digits, measure.unit)
    if value is not None and row is not None and limit.of in ("off_track", "off_track_share"):
        text = f"{row.off_track} of {count(row.drives, 'drive')}"
        # A car that ran into something went no farther off.
        if row.excess is not None and row.excess.collided:
            text += f", collided: {collisions(row.excess.collided)}"
    return Target(_what(limit), _limit_text(limit, bound), value, text, met, verdict, limit.paper)


def _what(limit: Limit) -> str:
    title = _MEASURES[limit.of].title
    if limit.what or not limit.of_drives:
        return limit.what or title
    scenario = f"{limit.scenario}, " if limit.scenario else ""
    victim = "" if limit.victim == "hardened" else f", victim {limit.victim}"
    return f"{scenario}{style_of(limit.method).title}{victim}, {limit.domain}: {title}"


def _limit_text(limit: Limit, bound: float | None) -> str:
    unit = _MEASURES[limit.of].unit
    if limit.above:
        return f"> {limit.above}" + ("" if bound is None else f" {bound:.2f}")
    return f"{'≤' if limit.at_most is not None else '≥'} {bound:g}{unit}"


def target_table(targets: Sequence[Target]) -> Table:
    """The targets as text."""
    cells = tuple((t.what, t.target, t.measured, t.verdict, t.paper) for t in targets)
    classes = tuple({True: "met", False: "missed", None: "unmeasured"}[t.met] for t in targets)
    columns = ("what", "target", "measured", "verdict", "paper")
    return Table("Targets", columns, cells, (False,) * 5, classes=classes)


def verdict(targets: Sequence[Target]) -> str:
    """Summary of met, missed and unmeasured targets, as text; empty without any."""
    met, missed = ([target for target in targets if target.met is wanted] for wanted in (True, False))
    judged = len(met) + len(missed)
    if not targets:
        return ""
    if not judged:
        return "No target was measured in this run."
    text = f"{len(met)} of {count(judged, 'measured target')} {'was' if judged == 1 else 'were'} met."
    if missed:
        listed = "; ".join(f"{t.what}: {t.measured} (target {t.target})" for t in missed)
        text += f" Missed: {listed}."
    if len(targets) > judged:
        text += f" {count(len(targets) - judged, 'target')} not measured in this run."
    return text
