"""The picture of a set: the excess of every drive, by method and domain."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from advnerf_core.report.conditions import NONE, style_of
from advnerf_core.report.evidence.results import Evidence, rows
from advnerf_core.report.palette import LIGHT
from advnerf_core.report.plots import new_axes


def excess_plot(evidence: Evidence) -> Figure:
    """Excess |CTE| per tick of each drive, one column per search, with the interval of the mean beside them."""
    shown = [row for row in rows(evidence) if row.method != NONE]
    with new_axes(max(5.0, 1.1 * len(shown) + 1.5), 3.4) as ax:
        ax.axhline(0.0, color=LIGHT["tape"], lw=1.0, zorder=1)
        for place, row in enumerate(shown):
            style, filled = style_of(row.method), row.domain == "deployed"
            cells = evidence.searches((row.scenario, row.placement, row.victim, row.method))
            across = np.linspace(-0.28, 0.16, len(cells)) if len(cells) > 1 else [0.0]
            for x, cell in zip(across, cells, strict=True):
                values = [each.excess_cte_m_per_tick for each in evidence.outcomes(cell, row.domain)]
                face = style.light if filled else "none"
                ax.plot([place + x] * len(values), values, "o", ms=3.5, mfc=face, mec=style.light, mew=0.9)
            if row.low_m is not None and row.high_m is not None:
                error = [[row.excess_m - row.low_m], [row.high_m - row.excess_m]]
                ax.errorbar(place + 0.3, row.excess_m, error, fmt="_", color=LIGHT["ink"], ms=7, capsize=3)
        names = [
            f"{style_of(row.method).title}\n{row.domain}\n{' '.join(filter(None, (row.scenario, row.placement)))}, {row.victim}"
            for row in shown
        ]
        ax.set_xticks(range(len(shown)), names, size=7.5)
        ax.set(ylabel="excess |CTE| per tick [m]", xlim=(-0.6, len(shown) - 0.4))
        ax.grid(axis="x", visible=False)
    figure: Figure = ax.figure
    return figure
