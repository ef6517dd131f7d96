"""Does an attack on one victim work on another? ``python -m benchmarks.victim_panel RUN_FOLDER``.

Drives every victim of ``launch/victim_panel.experiment.yaml`` past what the gradient found for every other one, in the run folder of the finished
experiment, from its measured starts. Only drives: nothing is searched.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from advnerf_core.files import write_atomically
from advnerf_core.geometry import Array
from advnerf_core.report.evidence.families import GRADIENT
from advnerf_core.report.palette import LIGHT
from advnerf_core.report.plots import new_axes, write_png
from benchmarks.results import REPOSITORY, record_row
from nodes.experiment.engine.run_folder import CELLS
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import Bench
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.deploy import drive_through_world
from nodes.experiment.steps.run import prepare_victims

_KEPT = REPOSITORY / "docs" / "results" / "victim_panel_matrix"
_PICTURE = REPOSITORY / "docs" / "victim_panel.png"
_FILE = "matrix.json"


def drives_of(experiment: Experiment) -> dict[str, Any]:
    """Drives of each victim past the attack on each.

    Returns:
        ``victims``, and by the name of the attacked one ``[victims driven][starts]``: ``total_cte_m`` and ``off_track``; without attack under ``none``.
    """
    prepare_victims(experiment)
    searched = [cell for cell in experiment.cells if cell.method == GRADIENT]
    found: dict[str, Any] = {"victims": [cell.victim for cell in searched], "ticks": experiment.limits.ticks}
    with Bench(experiment) as bench:
        for shown in (searched[0].clean, *searched):
            name = shown.victim if shown.searched else shown.method
            found[name] = [_drives(experiment, bench, shown, other.victim) for other in searched]
            print(f"drove past {name}", flush=True)
    return found


def _drives(experiment: Experiment, bench: Bench, shown: Cell, victim: str) -> dict[str, Any]:
    folder = experiment.folder / CELLS / shown.name
    assert bench.scene is not None, "the world drives"
    drives = drive_through_world(experiment, bench.scene, bench.space, replace(shown, victim=victim), folder)
    return {
        "total_cte_m": [drive.metrics.total_cte_m for drive in drives],
        "off_track": [drive.metrics.off_track for drive in drives],
    }


def excess_m(found: Mapping[str, Any]) -> Array:
    """Mean excess |CTE| per tick, ``[attacked victim, driven victim]`` [m]."""
    totals = {
        name: np.array([each["total_cte_m"] for each in found[name]]) for name in ("none", *found["victims"])
    }
    rows = [(totals[name] - totals["none"]).mean(axis=1) for name in found["victims"]]
    return np.array(rows) / found["ticks"]


def off_track(found: Mapping[str, Any]) -> Array:
    """Share of drives off the track, ``[attacked victim, driven victim]``."""
    return np.array([[np.mean(each["off_track"]) for each in found[name]] for name in found["victims"]])


def share_kept(excess: Array) -> float:
    """What attacks on others do to a victim over what its own does: a ratio of means over all pairs."""
    own = np.diag(excess)
    others = excess[~np.eye(len(excess), dtype=bool)]
    return float(others.mean() / own.mean())


def picture(victims: Sequence[str], excess: Array, off: Array) -> Figure:
    """The matrix: excess in colour, and in each field the excess and the share of drives off the track."""
    size = 1.6 + 0.85 * len(victims)
    with new_axes(size + 1.0, size) as ax:
        drawn = ax.imshow(excess, cmap="YlOrRd", vmin=0.0, vmax=max(float(excess.max()), 1e-3))
        for (row, column), value in np.ndenumerate(excess):
            colour = "white" if value > 0.6 * excess.max() else LIGHT["ink"]
            text = f"{value:.2f}\n{100 * off[row, column]:.0f} %"
            ax.text(column, row, text, ha="center", va="center", color=colour, fontsize=8)
        ax.set_xticks(range(len(victims)), victims, rotation=30, ha="right")
        ax.set_yticks(range(len(victims)), victims)
        ax.set(xlabel="victim that drives", ylabel="victim that was attacked")
        ax.grid(False)
        ax.figure.colorbar(drawn, label="excess |CTE| per tick [m]; below: drives off the track")
    return ax.figure


def main() -> None:
    """Drive, record the rows, and put numbers and picture into docs/."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path, help="run folder of the finished experiment")
    parser.add_argument("--dry", action="store_true", help="print only")
    options = parser.parse_args()
    experiment = Experiment.resolved_in(options.folder.resolve())
    found = drives_of(experiment)
    excess, off = excess_m(found), off_track(found)
    starts, names = len(found["none"][0]["total_cte_m"]), found["victims"]
    print("\n".join([str(names), str(excess.round(3)), str(off.round(2))]))
    if options.dry:
        return
    write_atomically(_KEPT / _FILE, json.dumps(found) + "\n")
    write_png(picture(names, excess, off), _PICTURE, dpi=110)
    record_row(
        "panel of victims: excess past an attack on another victim over that past the own one",
        round(share_kept(excess), 3),
        "x",
        "",
        None,
        f"python -m benchmarks.victim_panel {options.folder}",
        f"{len(names)} victims, green screen, one search each, {starts} starts, deployed; own: "
        + ", ".join(
            f"{name} {value:.2f} m ({100 * share:.0f} % off track)"
            for name, value, share in zip(names, np.diag(excess), np.diag(off), strict=True)
        ),
    )


if __name__ == "__main__":
    main()
