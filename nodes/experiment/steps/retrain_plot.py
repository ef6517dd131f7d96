"""The curve of attack and retraining: ratio of an attack against each victim, round after round."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from advnerf_core.report.palette import LIGHT, LINE_STYLES
from advnerf_core.report.plots import new_axes, write_png

_COLOURS = {"straight": "#3465a4", "right": "#b0123c", "left": "#dd9300"}


def draw(file: Path, rounds: Sequence[dict[str, Any]], pays_ratio: float) -> None:
    """Write `curve` as a PNG."""
    write_png(curve(rounds, pays_ratio), file, dpi=110)


def curve(rounds: Sequence[dict[str, Any]], pays_ratio: float) -> Figure:
    """Ratio to no attack of the original policy and after each retraining, surrogate dashed, deployed solid; and the ratio at which the loop stops."""
    with new_axes(8.0, 4.0) as ax:
        for scenario in rounds[0]["deployed"]:
            for domain, style in LINE_STYLES.items():
                values = [each[domain][scenario] for each in rounds]
                line = {"color": _COLOURS.get(scenario), "marker": "o", "ms": 4}
                ax.plot(range(len(values)), values, style, label=f"{scenario}, {domain}", **line)
        ax.axhline(pays_ratio, color=LIGHT["muted"], lw=0.8, ls=":", label=f"pays from {pays_ratio:g}")
        ax.axhline(1.0, color=LIGHT["muted"], lw=0.8)
        ax.set_xticks(range(len(rounds)), ["original", *map(str, range(1, len(rounds)))])
        # From a hundred down to one: on a linear axis the end of the loop is invisible.
        ax.set(xlabel="times retrained", ylabel="total CTE, attacked / not attacked", yscale="log")
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.figure.legend(loc="outside right upper")
    return ax.figure
