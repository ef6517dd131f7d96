"""The experiment's targets: what was promised, what was measured, and whether it was met. Nothing is rounded in our favour."""

# ruff: noqa: RUF001 (typography for readers: multiplication signs and dashes)

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from advnerf_core.driving.metrics import drives, mean_cte_limit_m
from advnerf_core.report.data import Domain, ReportData
from advnerf_core.report.tables import Table, TransferRow, find_row, number, transfer_rows

_NOT_MEASURED = "not measured in this run"


@dataclass(frozen=True)
class Target:
    """One target; `met` is None where this run did not measure it."""

    what: str
    target: str
    measured: str
    met: bool | None
    paper: str = ""

    @property
    def verdict(self) -> str:
        """The answer in words."""
        return {True: "met", False: "missed", None: "–"}[self.met]

    def record(self) -> dict[str, Any]:
        """The target as JSON-ready values."""
        return asdict(self)


def evaluate_targets(data: ReportData) -> tuple[Target, ...]:
    """All targets in the reader's order; those of `ReportData.checks` come last."""
    rows = transfer_rows(data)
    return (
        *_attack_targets(data, rows),
        *_drive_targets(data),
        *_fidelity_targets(data),
        _memory_target(data),
        _wall_time_target(data),
        *(
            Target(c.what, c.target, c.measured if c.met is not None else _NOT_MEASURED, c.met, c.paper)
            for c in data.checks
        ),
    )


def targets_table(targets: Sequence[Target]) -> Table:
    """The targets as text."""
    cells = tuple((t.what, t.target, t.measured, t.verdict, t.paper) for t in targets)
    classes = tuple({True: "met", False: "missed", None: "unmeasured"}[t.met] for t in targets)
    return Table(
        "Targets", ("what", "target", "measured", "verdict", "paper"), cells, (False,) * 5, classes=classes
    )


def _bound(
    what: str,
    target: str,
    value: float | None,
    holds: Callable[[float], bool],
    text: Callable[[float], str],
    paper: str = "",
) -> Target:
    if value is None:
        return Target(what, target, _NOT_MEASURED, None, paper)
    return Target(what, target, text(value), holds(value), paper)


def _attack_targets(data: ReportData, rows: Sequence[TransferRow]) -> tuple[Target, ...]:
    surrogate = find_row(rows, "surrogate", "gradient")
    return (
        _bound(
            "gradient attack, surrogate: total CTE",
            "≥ 3.3 × no attack",
            surrogate.ratio if surrogate else None,
            lambda v: v >= 3.3,
            lambda v: f"{v:.2f} ×",
            "3.3 ×",
        ),
        *_deployed_targets(data, find_row(rows, "deployed", "gradient")),
        _random_target(rows, "surrogate", "0.7 ×"),
        _random_target(rows, "deployed", "1.0 ×, 0 of 5"),
    )


def _deployed_targets(data: ReportData, row: TransferRow | None) -> tuple[Target, ...]:
    what = "gradient attack, live: "
    return (
        _bound(
            what + "total CTE",
            "≥ 3.0 × no attack",
            row.ratio if row else None,
            lambda v: v >= 3.0,
            lambda v: f"{v:.2f} ×",
            "5.2 ×",
        ),
        _bound(
            what + "mean |CTE|",
            "≥ 0.25 m",
            row.mean_abs_cte_m if row else None,
            lambda v: v >= 0.25,
            lambda v: f"{v:.3f} m",
        ),
        _bound(
            what + f"left the track (|CTE| > {data.settings.off_track_m:g} m)",
            "in ≥ 2 of 3 drives",
            row.off_track / row.runs if row else None,
            lambda v: v >= 2 / 3,
            lambda _: f"{row.off_track} of {row.runs}" if row else "",
            "on occasion",
        ),
    )


def _random_target(rows: Sequence[TransferRow], domain: Domain, paper: str) -> Target:
    row = find_row(rows, domain, "random")
    place = "live" if domain == "deployed" else domain
    what = f"best random texture, {place}: total CTE" + (
        " and drives that left" if domain == "deployed" else ""
    )
    target = "≤ 1.5 × no attack" + (", never off-track" if domain == "deployed" else "")
    if row is None or row.ratio is None:
        return Target(what, target, _NOT_MEASURED, None, paper)
    met = row.ratio <= 1.5 and (domain == "surrogate" or row.off_track == 0)
    measured = f"{row.ratio:.2f} ×" + (f", {row.off_track} of {row.runs}" if domain == "deployed" else "")
    return Target(what, target, measured, met, paper)


def _drive_targets(data: ReportData) -> tuple[Target, ...]:
    laps, latency = data.laps, data.latency
    off_track_m = data.settings.off_track_m
    what = "policy without attack, 3 laps live"
    target = f"mean |CTE| ≤ {mean_cte_limit_m(off_track_m):g} m, never off-track"
    if laps is None:
        drive = Target(what, target, _NOT_MEASURED, None)
    else:
        left = "left the track" if laps.off_track else "never off-track"
        met = laps.laps >= 3 and drives(laps.mean_abs_cte_m, laps.off_track, off_track_m)
        drive = Target(what, target, f"{laps.mean_abs_cte_m:.3f} m, {left}, {laps.laps} laps", met)
    what, target = "capture to serial write, live", "p99 ≤ one camera period, no tick missed"
    if latency is None:
        return drive, Target(what, target, _NOT_MEASURED, None, "10 Hz")
    p99 = latency.overall.p99_ms
    missed = (
        "missed ticks not counted" if latency.missed_ticks is None else f"{latency.missed_ticks} ticks missed"
    )
    # Not counting missed ticks can disprove the target, never prove it.
    met_or_unknown = (
        False
        if p99 > latency.camera_period_ms or latency.missed_ticks
        else (latency.missed_ticks is not None or None)
    )
    measured = f"p99 {p99:.1f} ms of {latency.camera_period_ms:g} ms, {missed}"
    return drive, Target(what, target, measured, met_or_unknown, "10 Hz")


def _fidelity_targets(data: ReportData) -> tuple[Target, ...]:
    f = data.fidelity
    minor = "“minor perceptual gap”"

    def decibel(v: float) -> str:
        return f"{v:.1f} dB"

    return (
        _bound(
            "surrogate on held-out views, full size",
            "PSNR ≥ 27 dB",
            f.mean("psnr_full_db") if f else None,
            lambda v: v >= 27,
            decibel,
            minor,
        ),
        _bound(
            "surrogate on held-out views, 200x66",
            "PSNR ≥ 27 dB",
            f.mean("psnr_policy_db") if f else None,
            lambda v: v >= 27,
            decibel,
            minor,
        ),
        _bound(
            "steering on surrogate against real views",
            "mean difference ≤ 0.03 rad",
            f.steering_difference_rad if f else None,
            lambda v: v <= 0.03,
            lambda v: f"{v:.4f} rad",
        ),
    )


def _memory_target(data: ReportData) -> Target:
    what, target = "adjoint, peak memory above idle", "T = 400 ≤ 1.1 × T = 50"
    rows = {m.horizon_steps: m.adjoint_mib for m in data.memory}
    if 50 not in rows or 400 not in rows or rows[50] <= 0:
        return Target(what, target, _NOT_MEASURED, None, "“constant”")
    ratio = rows[400] / rows[50]
    return Target(
        what,
        target,
        f"{ratio:.2f} × ({number(rows[50], 0)} and {number(rows[400], 0)} MiB)",
        ratio <= 1.1,
        "“constant”",
    )


def _wall_time_target(data: ReportData) -> Target:
    limit_s, target = (1200.0, "≤ 20 min") if data.settings.name == "small" else (7200.0, "≤ 2 h")
    what = "clean clone to report, 2 cores" if data.settings.name == "small" else "full setting, 2 cores"
    cached = [t.name for t in data.timings if t.cached]
    wall_s = None if cached else data.manifest.wall_s
    return _bound(what, target, wall_s, lambda v: v <= limit_s, lambda v: f"{v / 60:.1f} min")
