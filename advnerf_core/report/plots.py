"""The curves of the report. Each function returns a matplotlib figure drawn without a display; `svg` embeds it in a page.

Conditions keep their colour in every figure; the surrogate is dashed, the deployed drive solid.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup, escape
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from advnerf_core.files import write_atomically
from advnerf_core.report.conditions import EMPTY, NONE, order_of, style_of
from advnerf_core.report.data import Drives, Fidelity, Laps, Latency, Run
from advnerf_core.report.palette import LIGHT, LINE_STYLES, themed_svg
from advnerf_core.report.reference import Domain

STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "svg.fonttype": "none",
    "svg.hashsalt": "advnerf",
    "text.color": LIGHT["ink"],
    "axes.edgecolor": LIGHT["muted"],
    "axes.labelcolor": LIGHT["ink"],
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "grid.color": LIGHT["grid"],
    "grid.linewidth": 0.7,
    "xtick.color": LIGHT["muted"],
    "ytick.color": LIGHT["muted"],
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 2.6,
    "lines.linewidth": 1.6,
    "lines.solid_capstyle": "round",
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
}


@contextmanager
def new_axes(width_in: float = 6.0, height_in: float = 3.4) -> Iterator[Any]:
    """Axes of a new figure in the report's style."""
    with matplotlib.rc_context(STYLE):
        yield Figure(figsize=(width_in, height_in), layout="constrained").add_subplot()


@contextmanager
def _cte_axes(height_in: float, off_track_m: float, largest_m: float, longest_s: float) -> Iterator[Any]:
    """Axes of the signed cross-track error over time, with the band that counts as on track."""
    with new_axes(6.0, height_in) as ax:
        ax.axhspan(-off_track_m, off_track_m, color=LIGHT["band"], lw=0, zorder=0)
        ax.axhline(0.0, color=LIGHT["tape"], lw=1.2, zorder=1)
        limit = max(off_track_m * 1.25, largest_m) * 1.08
        ax.set(xlabel="time [s]", ylabel="cross-track error, left + [m]", ylim=(-limit, limit))
        ax.set_xlim(0.0, longest_s)
        where = {"xycoords": ("axes fraction", "data"), "xytext": (-4, -4), "textcoords": "offset points"}
        ax.annotate("on track", (1, off_track_m), ha="right", va="top", color=LIGHT["muted"], size=8, **where)
        yield ax


def cte_over_time(drives: Drives, domain: Domain, victim: str) -> Figure:
    """Signed cross-track error of all drives in one domain; both axes are shared by all domains and victims."""
    largest_m = max(float(abs(r.cte_m).max()) for r in drives.runs)
    longest_s = max(len(r.cte_m) for r in drives.runs) * drives.dt_s
    with _cte_axes(3.4, drives.scene.off_track_m, largest_m, longest_s) as ax:
        runs = drives.select(domain=domain, victim=victim)
        for run in runs:
            ax.plot(np.arange(len(run.cte_m)) * drives.dt_s, run.cte_m, **run_style(run))
            ax.plot((len(run.cte_m) - 1) * drives.dt_s, run.cte_m[-1], **end_style(run))
        ax.set_title(domain)
        add_run_legend(ax, runs)
    return ax.figure


def loss_curves(drives: Drives, victim: str) -> Figure:
    """The value of each evaluation of the searches, by default their excess; the axes are shared by all victims."""
    curves = [c for c in drives.curves if c.victim == victim]
    plain = {c.plain for c in drives.curves if c.plain is not None}
    every = np.concatenate([*(c.values for c in drives.curves), list(plain)])
    low, high = float(every.min()), float(every.max())
    handles = []
    with new_axes() as ax:
        for value in sorted({c.plain for c in curves if c.plain is not None}):
            ax.axhline(value, color=LIGHT[NONE], ls="--", lw=1.2, zorder=1)
        for curve in curves:
            x, style = np.arange(1, len(curve.values) + 1), style_of(curve.method)
            if style.climbs:
                ax.plot(x, curve.values, color=style.light)
                ax.plot(x[-1], curve.values[-1], marker=style.marker, ms=5, color=style.light)
            else:
                dots = {"marker": style.marker, "ls": "none", "ms": 2.4, "alpha": 0.55, "mew": 0}
                ax.plot(x, curve.values, color=style.light, **dots)
                ax.plot(x, np.maximum.accumulate(curve.values), drawstyle="steps-post", color=style.light)
        methods = {c.method for c in curves}
        for method in sorted(methods, key=lambda name: (not style_of(name).climbs, order_of(name))):
            style = style_of(method)  # lines before dots
            text = f"{method}, one line per seed" if style.climbs else f"{method}: each texture, best so far"
            marker: Any = None if style.climbs else style.marker
            handles.append(Line2D([], [], color=style.light, label=text, marker=marker, ms=2.4))
        if plain:
            handles.append(Line2D([], [], color=LIGHT[NONE], ls="--", lw=1.2, label="plain object"))
        longest, goal = max(len(c.values) for c in drives.curves), drives.maximised
        what, unit = ("excess |CTE| per tick", "m") if goal is None else (goal.name, goal.unit)
        ax.set(xlabel="evaluation", ylabel=f"{what}, learned scene [{unit}]", xlim=(0.0, longest + 1.0))
        margin = 0.05 * (high - low)
        ax.set_ylim(low - margin, high + margin if margin else low + 1.0)
        _legend_above(ax, handles)
    return ax.figure


def steering_agreement(fidelity: Fidelity) -> Figure:
    """The policy's control on the surrogate's image against that on the real image."""
    pairs = fidelity.steering_rad
    low, high = float(pairs.min()), float(pairs.max())
    tolerance = 0.03
    margin = max(0.06 * (high - low), tolerance)
    line = np.array([low - margin, high + margin])
    with new_axes(4.2, 3.9) as ax:
        ax.fill_between(line, line - tolerance, line + tolerance, color=LIGHT["band"], lw=0)
        ax.plot(line, line, color=LIGHT["tape"], lw=1.0)
        ax.plot(pairs[:, 0], pairs[:, 1], "o", ms=4, mew=0, alpha=0.75, color=LIGHT["ink"])
        ax.set(
            xlabel=f"control on the real image [{fidelity.unit}]",
            ylabel=f"control on the surrogate's image [{fidelity.unit}]",
            xlim=line,
            ylim=line,
        )
        ax.set_aspect("equal")
        text = f"mean |difference| {fidelity.steering_difference_rad:.4f} {fidelity.unit}\nband: ± {tolerance:g} {fidelity.unit}, n = {len(pairs)}"
        ax.text(0.04, 0.96, text, transform=ax.transAxes, va="top", size=8.5)
    return ax.figure


def latency_histogram(latency: Latency) -> Figure:
    """Distribution of the time from capture to serial write, with the camera period as the limit."""
    samples, limit, p99_ms = latency.capture_to_serial_ms, latency.camera_period_ms, latency.p99_ms
    end = max(limit * 1.12, float(samples.max()) * 1.05)
    with new_axes(6.0, 2.9) as ax:
        ax.hist(samples, bins=np.linspace(0.0, end, 90).tolist(), color=LIGHT["muted"], log=True)
        ax.axvline(limit, color=LIGHT["ink"], lw=1.4)
        ax.axvline(p99_ms, color=LIGHT["ink"], lw=1.2, ls=":")
        side = "right" if end < limit * 1.3 else "center"
        for at, text, colour, ha in (
            (limit, f"camera period {limit:g} ms", "ink", side),
            (p99_ms, f"p99 {p99_ms:.1f} ms", "muted", "center"),
        ):
            ax.text(at, 1.01, text, transform=ax.get_xaxis_transform(), ha=ha, size=8.5, color=LIGHT[colour])
        ax.set(xlabel="capture to serial write [ms]", ylabel="frames", xlim=(0.0, end))
    return ax.figure


def laps_cte(laps: Laps, period_s: float, off_track_m: float) -> Figure:
    """Signed cross-track error of the drive without attack."""
    times_s = np.arange(len(laps.cte_m)) * period_s
    with _cte_axes(2.6, off_track_m, float(abs(laps.cte_m).max()), float(times_s[-1])) as ax:
        ax.plot(times_s, laps.cte_m, color=LIGHT["laps"], lw=1.2)
    return ax.figure


def run_style(run: Run) -> dict[str, Any]:
    """Style of a drive: colour by condition, line by domain."""
    style = style_of(run.condition)
    # Attacks in front of drives without one, and these in front of the empty scene.
    front = {EMPTY: 2.0, NONE: 2.1}.get(run.condition, 2.2 + 0.01 * order_of(run.condition)[0])
    return {"color": style.light, "ls": LINE_STYLES[run.domain], "zorder": front, "alpha": 0.9}


def end_style(run: Run) -> dict[str, Any]:
    """The mark at the end of a drive: shape by condition, filled if deployed."""
    style = style_of(run.condition)
    fill = style.light if run.domain == "deployed" else LIGHT["paper"]
    return {"marker": style.marker, "ms": 5, "color": style.light, "mfc": fill, "ls": "none", "zorder": 3}


def add_run_legend(ax: Any, runs: Iterable[Run]) -> None:
    """A legend of the present conditions and domains, above the axes."""
    cells: dict[tuple[str, str], Run] = {(r.condition, r.domain): r for r in runs}
    handles = []
    for condition in sorted({condition for condition, _ in cells}, key=order_of):
        for domain in LINE_STYLES:
            if run := cells.get((condition, domain)):
                style = {
                    **run_style(run),
                    **{k: v for k, v in end_style(run).items() if k in ("marker", "ms", "mfc")},
                }
                handles.append(Line2D([], [], label=f"{style_of(condition).title}, {domain}", **style))
    _legend_above(ax, handles)


def _legend_above(ax: Any, handles: list[Any]) -> None:
    if handles:
        columns = 3 if len(handles) in (3, 5, 6) else 2
        ax.figure.legend(handles=handles, loc="outside upper left", ncols=columns, columnspacing=1.6)


def svg(figure: Figure, description: str) -> Markup:
    """A figure as inline SVG in the page's colours: no scripts, no external names, text as text.

    The description is plain text for readers who cannot see the figure; it is escaped.
    """
    buffer = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format="svg", metadata=nothing)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r'\s+xmlns(:xlink)?="[^"]*"', "", text)
    text = text.replace("xlink:href", "href")
    width_px = figure.get_figwidth() * 90  # one text size in all figures where there is room
    view_box = re.search(r'viewBox="([^"]+)"', text)
    shown = f'viewBox="{view_box[1]}"' if view_box else ""
    label = f'role="img" aria-label="{escape(description)}" style="max-width: {width_px:.0f}px"'
    text = f"<svg {shown} {label}>" + text[text.index(">") + 1 :]
    return Markup(themed_svg(text))


def write_png(figure: Figure, path: Path, dpi: int = 160) -> Path:
    """Write a figure as a picture on white, atomically."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format="png", dpi=dpi, facecolor="white")
    write_atomically(path, buffer.getvalue())
    return path
