"""The picture of a set: the excess of every drive, by condition, method and domain."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from advnerf_core.report.conditions import NONE, style_of
from advnerf_core.report.evidence.results import Evidence, rows
from advnerf_core.report.evidence.rows import Row
from advnerf_core.report.evidence.words import DOMAIN_TITLES
from advnerf_core.report.palette import LIGHT
from advnerf_core.report.plots import new_axes

_MOST_COLUMNS = 8
# Of the distance between methods.
_DOMAINS_APART = 0.27


def excess_plot(evidence: Evidence, titles: Mapping[str, str]) -> Figure:
    """Excess |CTE| per tick of each drive, one column per search; for sets with many conditions the means, one line per condition.

    ``titles`` has the names of victims on pages, if they differ.
    """
    shown = [row for row in rows(evidence) if row.method != NONE]
    return _drives(evidence, shown, titles) if len(shown) <= _MOST_COLUMNS else _means(shown, titles)


def _drives(evidence: Evidence, shown: list[Row], titles: Mapping[str, str]) -> Figure:
    """Every drive, with the interval of the mean beside them."""
    with new_axes(max(5.0, 1.1 * len(shown) + 1.5), 3.4) as ax:
        ax.axhline(0.0, color=LIGHT["tape"], lw=1.0, zorder=1)
        for place, row in enumerate(shown):
            style, filled = style_of(row.method), row.domain == "deployed"
            cells = evidence.searches(row.key)
            across = np.linspace(-0.28, 0.16, len(cells)) if len(cells) > 1 else [0.0]
            for x, cell in zip(across, cells, strict=True):
                values = evidence.excesses_m(cell, row.domain)
                face = style.light if filled else "none"
                ax.plot([place + x] * len(values), values, "o", ms=3.5, mfc=face, mec=style.light, mew=0.9)
            if row.low_m is not None and row.high_m is not None:
                error = [[row.excess_m - row.low_m], [row.high_m - row.excess_m]]
                ax.errorbar(place + 0.3, row.excess_m, error, fmt="_", color=LIGHT["ink"], ms=7, capsize=3)
        names = [
            f"{style_of(row.method).title}\n{DOMAIN_TITLES[row.domain]}\n{row.scenario},"
            f"\n{titles.get(row.victim, row.victim)}"
            for row in shown
        ]
        ax.set_xticks(range(len(shown)), names, size=7.5)
        ax.set(ylabel="excess |CTE| per tick over the plain object [m]", xlim=(-0.6, len(shown) - 0.4))
        ax.grid(axis="x", visible=False)
    return ax.figure


def _means(shown: list[Row], titles: Mapping[str, str]) -> Figure:
    """Means with their intervals: deployed ones filled, surrogate ones hollow."""
    places = list(dict.fromkeys(row.key[:2] for row in shown))
    methods = list(dict.fromkeys(row.method for row in shown))
    apart = min(0.22, 0.85 / len(methods))
    with new_axes(7.2, 0.9 + max(0.42, 0.14 * len(methods)) * len(places)) as ax:
        ax.axvline(0.0, color=LIGHT["tape"], lw=1.0, zorder=1)
        for row in shown:
            style, filled = style_of(row.method), row.domain == "deployed"
            down = float(places.index(row.key[:2]))
            aside = methods.index(row.method) - 0.5 * (len(methods) - 1)
            down += apart * (aside + (_DOMAINS_APART if filled else -_DOMAINS_APART))
            if row.low_m is not None and row.high_m is not None:
                ax.plot([row.low_m, row.high_m], [down, down], color=style.light, lw=1.2, zorder=2)
            label = f"{style.title}, {DOMAIN_TITLES[row.domain]}"
            drawn = {
                "color": style.light,
                "mfc": style.light if filled else LIGHT["paper"],
                "ms": 5,
                "zorder": 3,
            }
            ax.plot([row.excess_m], [down], marker=style.marker, ls="none", label=label, **drawn)
        entries = dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
        # The widest legend has the titles of coarse methods in all columns.
        spacing = {"columnspacing": 0.8, "handletextpad": 0.4} if len(entries) >= 12 else {}
        ax.figure.legend(entries.values(), entries.keys(), loc="outside upper left", ncols=3, **spacing)
        names = [f"{scenario}, {titles.get(victim, victim)}" for scenario, victim in places]
        ax.set_yticks(range(len(places)), [name.replace("_", " ") for name in names])
        ax.set(xlabel="excess |CTE| per tick over the plain object [m]", ylim=(len(places) - 0.5, -0.5))
        ax.grid(axis="y", visible=False)
    return ax.figure
