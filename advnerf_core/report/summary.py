# ruff: noqa: RUF001 (typography for readers: multiplication signs and dashes)
"""What happened, in words: the opening paragraph and the key figures of the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from advnerf_core.driving.metrics import drives, mean_cte_limit_m
from advnerf_core.report.conditions import style_of
from advnerf_core.report.data import Domain, ReportData
from advnerf_core.report.tables import TransferRow, find_row, number, transfer_rows
from advnerf_core.report.targets import Target, evaluate_targets

_COMPARED = ("none", "gradient", "random")


@dataclass(frozen=True)
class KeyFigure:
    """One number of the page's head; `met` is None without a target or a measurement."""

    value: str
    label: str
    target: str
    met: bool | None
    condition: str = ""


def key_figures(data: ReportData) -> tuple[KeyFigure, ...]:
    """The numbers a reader looks for first: the targets that have a headline."""
    return tuple(
        KeyFigure(
            "–" if target.met is None else target.measured,
            target.headline,
            f"target {target.target}",
            target.met,
            target.condition,
        )
        for target in evaluate_targets(data)
        if target.headline
    )


def opening(data: ReportData) -> tuple[str, ...]:
    """The opening paragraphs as plain text: what was done, what it did, what that is worth."""
    story = f"{_what_was_done(data)} {_what_it_did(data)}"
    return tuple(p for p in (not_driven(data), story, verdict(evaluate_targets(data)), _caveats(data)) if p)


def not_driven(data: ReportData) -> str:
    """Which arms were not driven live, and what that means; empty if all were."""
    missing = [t for t in data.live_tries if not t.driven]
    if not missing:
        return ""
    arms = ", ".join(f"{style_of(t.condition).title} ({t.victim}, seed {t.seed})" for t in missing)
    return (
        f"NOT DRIVEN LIVE: {arms}. Load or a fault of the stack spoiled every try, at last: {missing[-1].spoiled[-1]}. For these arms the "
        "report has only the synchronous drives in the learned scene, which are no evidence of transfer. On a machine without other load, "
        "give the command again with --retry."
    )


def _what_was_done(data: ReportData) -> str:
    s = data.settings
    starts, seeds = len(s.start_poses), len(s.seeds)
    live = any(r.domain == "deployed" and r.condition == "gradient" for r in data.runs)
    shown = (
        " Both were then shown to the driving car, frame by frame, by the live node graph." if live else ""
    )
    return (
        f"A texture for one flat board was searched for in a learned scene of the room: {s.iterations} gradient steps over "
        f"{s.horizon_steps} control ticks ({s.horizon_steps * s.control_period_s:g} s) from {_count(starts, 'start pose')} with "
        f"{_count(seeds, 'seed')}, against the best of {s.random_evaluations} random textures.{shown}"
    )


def _what_it_did(data: ReportData) -> str:
    rows = transfer_rows(data)
    surrogate, deployed = (
        _effect(rows, domain, data.settings.off_track_m) for domain in ("surrogate", "deployed")
    )
    return (
        f"In the learned scene the total cross-track error (total CTE, the summed distance from the tape) {surrogate}. "
        f"On the live drive it {deployed}."
    )


def _effect(rows: Sequence[TransferRow], domain: Domain, off_track_m: float) -> str:
    clean, attacked, random = (find_row(rows, domain, c) for c in _COMPARED)
    if clean is None or attacked is None:
        return "was not measured in this run"
    text = (
        f"went from {clean.total_cte_mean_m:.2f} m without attack to {attacked.total_cte_mean_m:.2f} m with the gradient texture "
        f"({number(attacked.ratio)} ×), and the car left the track in {attacked.off_track} of {_count(attacked.runs, 'drive')}"
    )
    if random is not None:
        text += f"; with the best random texture it was {number(random.ratio)} ×, and the car left in {random.off_track} of {random.runs}"
    return text + _warning(clean, off_track_m)


def _warning(clean: TransferRow, off_track_m: float) -> str:
    """What must be said of a victim that does not drive without an attack; empty if it drives."""
    if drives(clean.mean_abs_cte_m, clean.off_track > 0, off_track_m):
        return ""
    return (
        f"; but WITHOUT AN ATTACK THE POLICY DOES NOT DRIVE here (mean |CTE| {clean.mean_abs_cte_m:.3f} m, expected "
        f"<= {mean_cte_limit_m(off_track_m):g} m; off the track in {clean.off_track} of {clean.runs}), so this ratio proves nothing"
    )


def verdict(targets: Sequence[Target]) -> str:
    """Which targets were met, missed, and not measured."""
    met = [t for t in targets if t.met is True]
    missed = [t for t in targets if t.met is False]
    judged = len(met) + len(missed)
    if not targets:
        return ""
    if not judged:
        return "No target was measured in this run."
    text = f"{len(met)} of {_count(judged, 'measured target')} {'was' if judged == 1 else 'were'} met."
    if missed:
        listed = "; ".join(f"{t.what}: {t.measured} (target {t.target})" for t in missed)
        text += f" Missed: {listed}."
    if len(targets) > judged:
        text += f" {_count(len(targets) - judged, 'target')} not measured in this run."
    return text


def _caveats(data: ReportData) -> str:
    if data.settings.name == "full":
        return ""
    return (
        "This is the small setting: it shows that the whole chain works, and its total CTE ratios rest on very few drives. The targets "
        "are stated for the full setting (make experiment)."
    )


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
