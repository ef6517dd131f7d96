"""The curve of attack and retraining: ratio of an attack against each victim, round after round."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from advnerf_core.files import write_atomically

_COLOURS = {"straight": "#3465a4", "right": "#b0123c", "left": "#dd9300"}


def draw(file: Path, rounds: Sequence[dict[str, Any]], pays_ratio: float) -> None:
    """Write `curve` as a PNG."""
    buffer = io.BytesIO()
    curve(rounds, pays_ratio).savefig(buffer, format="png")
    write_atomically(file, buffer.getvalue())


def curve(rounds: Sequence[dict[str, Any]], pays_ratio: float) -> Figure:
    """Ratio to no attack of the original policy and after each retraining, surrogate dashed, deployed solid; and the ratio at which the loop stops."""
    figure = Figure(figsize=(8.0, 4.0), dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for scenario in rounds[0]["deployed"]:
        for domain, style in (("surrogate", "--"), ("deployed", "-")):
            values = [each[domain][scenario] for each in rounds]
            label = f"{scenario}, {domain}"
            axes.plot(
                range(len(values)), values, style, marker="o", ms=4, color=_COLOURS.get(scenario), label=label
            )
    axes.axhline(pays_ratio, color="0.4", lw=0.8, ls=":", label=f"pays from {pays_ratio:g}")
    axes.axhline(1.0, color="0.8", lw=0.8)
    axes.set_xticks(range(len(rounds)), ["original", *map(str, range(1, len(rounds)))])
    axes.set_xlabel("times retrained")
    axes.set_ylabel("total CTE, attacked / not attacked")
    # From a hundred down to one: on a linear axis the end of the loop is invisible.
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return figure
