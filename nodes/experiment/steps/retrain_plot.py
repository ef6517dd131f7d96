"""The curve of attack and retraining: excess of an attack against each victim, round after round."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from advnerf_core.report.palette import LIGHT, LINE_STYLES
from advnerf_core.report.plots import new_axes, write_png

_COLOURS = {"straight": "#3465a4", "right": "#b0123c", "left": "#dd9300"}


def draw(file: Path, rounds: Sequence[dict[str, Any]], pays_m: float) -> None:
    """Write `curve` as a PNG."""
    write_png(curve(rounds, pays_m), file, dpi=110)


def curve(rounds: Sequence[dict[str, Any]], pays_m: float) -> Figure:
    """Excess |CTE| per tick of the original policy and after each retraining, surrogate dashed, deployed solid; and the one at which the loop stops."""
    with new_axes(8.0, 4.0) as ax:
        for scenario in rounds[0]["deployed"]:
            for domain, style in LINE_STYLES.items():
                values = [each[domain][scenario] for each in rounds]
                line = {"color": _COLOURS.get(scenario), "marker": "o", "ms": 4}
                ax.plot(range(len(values)), values, style, label=f"{scenario}, {domain}", **line)
        ax.axhline(pays_m, color=LIGHT["muted"], lw=0.8, ls=":", label=f"pays above {pays_m:g} m")
        ax.axhline(0.0, color=LIGHT["muted"], lw=0.8)
        ax.set_xticks(range(len(rounds)), ["original", *map(str, range(1, len(rounds)))])
        ax.set(xlabel="times retrained", ylabel="excess |CTE| per tick [m]")
        ax.figure.legend(loc="outside right upper")
    return ax.figure
