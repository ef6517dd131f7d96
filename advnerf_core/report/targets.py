"""The targets of a live experiment: what was promised, what was measured, and whether it was met. Nothing is rounded in our favour."""

# ruff: noqa: RUF001 (typography for readers: multiplication signs and dashes)

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from advnerf_core.report.data import ReportData
from advnerf_core.report.reference import LiveLimit, LiveMeasure
from advnerf_core.report.tables import Table, TransferRow, find_row, number, transfer_rows

_NOT_MEASURED = "not measured in this run"
_SHORT_TICKS, _LONG_TICKS = 50, 400  # horizons whose memory is compared


@dataclass(frozen=True)
class Target:
    """One target; `met` is None where this run did not measure it."""

    what: str
    target: str
    measured: str
    met: bool | None
    paper: str = ""
    headline: str = ""
    condition: str = ""

    @property
    def verdict(self) -> str:
        """The answer in words."""
        return {True: "met", False: "missed", None: "–"}[self.met]

    def record(self) -> dict[str, Any]:
        """The target as JSON-ready values."""
        return asdict(self)


@dataclass(frozen=True)
class _Measure:
    """How a measure is read off a report, and how its values are printed."""

    read: Callable[[ReportData, LiveLimit], float | None]
    digits: int
    unit: str = ""

    def text(self, value: float) -> str:
        return number(value, self.digits, self.unit)


def evaluate_targets(data: ReportData) -> tuple[Target, ...]:
    """All targets of the report's limits, in their order."""
    return tuple(_target(data, limit) for limit in data.limits if limit.setting in ("", data.settings.name))


def targets_table(targets: Sequence[Target]) -> Table:
    """The targets as text."""
    cells = tuple((t.what, t.target, t.measured, t.verdict, t.paper) for t in targets)
    classes = tuple({True: "met", False: "missed", None: "unmeasured"}[t.met] for t in targets)
    return Table(
        "Targets", ("what", "target", "measured", "verdict", "paper"), cells, (False,) * 5, classes=classes
    )


def _target(data: ReportData, limit: LiveLimit) -> Target:
    measure = _MEASURES[limit.of]
    value = measure.read(data, limit)
    sign, bound = ("≥", limit.at_least) if limit.at_least is not None else ("≤", limit.at_most)
    assert bound is not None, "a limit has one bound"
    met = None if value is None else value >= bound if sign == "≥" else value <= bound
    measured = _NOT_MEASURED if value is None else measure.text(value)
    said = f"{sign} {bound:g}{measure.unit}"
    return Target(limit.what, said, measured, met, limit.paper, limit.headline, limit.method)


def _of_row(read: Callable[[TransferRow], float | None]) -> Callable[[ReportData, LiveLimit], float | None]:
    def found(data: ReportData, limit: LiveLimit) -> float | None:
        row = find_row(transfer_rows(data), limit.domain, limit.method)
        return None if row is None else read(row)

    return found


def _of_fidelity(name: str) -> Callable[[ReportData, LiveLimit], float | None]:
    return lambda data, limit: data.fidelity.mean(name) if data.fidelity else None


def _steering(data: ReportData, limit: LiveLimit) -> float | None:
    return data.fidelity.steering_difference_rad if data.fidelity else None


def _laps(read: Callable[[Any], float]) -> Callable[[ReportData, LiveLimit], float | None]:
    return lambda data, limit: read(data.laps) if data.laps else None


def _latency(data: ReportData, limit: LiveLimit) -> float | None:
    return data.latency.overall.p99_ms if data.latency else None


def _missed_ticks(data: ReportData, limit: LiveLimit) -> float | None:
    return data.latency.missed_ticks if data.latency else None


def _memory(data: ReportData, limit: LiveLimit) -> float | None:
    rows = {m.horizon_steps: m.adjoint_mib for m in data.memory}
    short, long = rows.get(_SHORT_TICKS), rows.get(_LONG_TICKS)
    return None if short is None or long is None or short <= 0 else long / short


def _wall_min(data: ReportData, limit: LiveLimit) -> float | None:
    """Only of a run that made everything."""
    cached = any(timing.cached for timing in data.timings)
    return None if cached or data.manifest.wall_s is None else data.manifest.wall_s / 60


_MEASURES: Mapping[LiveMeasure, _Measure] = {
    "ratio": _Measure(_of_row(lambda row: row.ratio), 2, " × no attack"),
    "mean_abs_cte_m": _Measure(_of_row(lambda row: row.mean_abs_cte_m), 3, " m"),
    "off_track": _Measure(_of_row(lambda row: float(row.off_track)), 0, " drives"),
    "off_track_share": _Measure(_of_row(lambda row: row.off_track / row.runs), 2, " of the drives"),
    "laps": _Measure(_laps(lambda laps: laps.laps), 0, " laps"),
    "laps_mean_abs_cte_m": _Measure(_laps(lambda laps: laps.mean_abs_cte_m), 3, " m"),
    "laps_off_track": _Measure(_laps(lambda laps: float(laps.off_track)), 0, " drives"),
    "latency_p99_ms": _Measure(_latency, 1, " ms"),
    "missed_ticks": _Measure(_missed_ticks, 0, " ticks"),
    "psnr_full_db": _Measure(_of_fidelity("psnr_full_db"), 1, " dB"),
    "psnr_policy_db": _Measure(_of_fidelity("psnr_policy_db"), 1, " dB"),
    "steering_difference_rad": _Measure(_steering, 4, " rad"),
    "memory_ratio": _Measure(_memory, 2, " ×"),
    "wall_min": _Measure(_wall_min, 1, " min"),
}
