"""The curve of attack and retraining: how much an attack pays against each victim, round after round."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from advnerf_core.files import write_atomically

_COLOURS = {"straight": "#3465a4", "right": "#b0123c", "left": "#dd9300"}


def draw(file: Path, rounds: Sequence[dict[str, Any]], pays_ratio: float) -> None:
    """Write a PNG: ratio to no attack by round, surrogate dashed, deployed solid; the line below which an attack does not pay."""
    figure = Figure(figsize=(7.0, 4.0), dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for scenario in rounds[0]["deployed"]:
        for domain, style in (("surrogate", "--"), ("deployed", "-")):
            values = [each[domain][scenario] for each in rounds]
            label = f"{scenario}, {domain}"
            axes.plot(range(len(values)), values, style, marker="o", ms=4, color=_COLOURS.get(scenario), label=label)
    axes.axhline(pays_ratio, color="0.5", lw=0.8)
    axes.text(0.0, pays_ratio, "below: does not pay", va="bottom", fontsize=8, color="0.4")
    axes.axhline(1.0, color="0.8", lw=0.8)
    axes.set_xticks(range(len(rounds)), ["original", *(f"retrained {k}x" for k in range(1, len(rounds)))])
    axes.set_ylabel("total CTE, attacked / not attacked")
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=8, ncols=2)
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_atomically(file, buffer.getvalue())
