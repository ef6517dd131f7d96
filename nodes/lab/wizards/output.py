"""Output that all calibration commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from nodes.runtime.terminal import print_table, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calibration.schema import Calibration


def keep_inputs(output: Path, *inputs: Path | None) -> None:
    """Refuse an output that would overwrite an input with the calibration file or its plot, before any work."""
    from advnerf_core.files import refuse_overwriting
    from calibration.plots import plot_beside

    refuse_overwriting(inputs, (output, plot_beside(output)))


def save_and_print(calibration: Calibration, output: Path, draw: Callable[[Figure], None]) -> None:
    """Write the calibration file and its plot, and print the residuals of the fit."""
    from calibration.plots import save_with_plot

    picture = save_with_plot(calibration, output, draw)
    rows = table("residual", "value")
    for key, value in calibration.residuals.items():
        rows.add_row(key, f"{value:.5g}")
    print_table(rows)
    print(f"{output}\n{picture}")
