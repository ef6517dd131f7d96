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

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Array
from advnerf_core.report.evidence.families import GRADIENT
from advnerf_core.report.evidence.verifying.layout import SET
from advnerf_core.report.palette import LIGHT
from advnerf_core.report.plots import new_axes, write_png
from benchmarks.results import REPOSITORY, LedgerRow
from nodes.experiment.engine.run_folder import CELLS
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import Bench
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.deploy import drive_through_world
from nodes.experiment.steps.run import prepare_victims

KEPT = REPOSITORY / "docs" / "results" / "victim_panel_drives.json"
_SET = REPOSITORY / "docs" / "results" / "victim_panel" / SET
_PICTURE = REPOSITORY / "docs" / "victim_panel.png"
COMMAND = "python -m benchmarks.victim_panel"


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


def rows_of(found: Mapping[str, Any]) -> list[LedgerRow]:
    """What its own attack does to each victim, and what those on others do."""
    excess, off, names = excess_m(found), off_track(found), found["victims"]
    starts = len(found["none"][0]["total_cte_m"])
    of = f"green screen, one search of the gradient, {starts} starts, deployed"
    rows = []
    for at, name in enumerate(names):
        others = np.delete(excess[:, at], at)
        note = (
            f"{of}; {100 * off[at, at]:.0f} % of its drives off the track; past the attacks on others {others.min():.3f} to "
            f"{others.max():.3f} m"
        )
        line = f"panel of victims, {name}: excess past the attack on it"
        rows.append(LedgerRow(line, round(float(excess[at, at]), 3), "m per tick", "", None, COMMAND, note))
    line = "panel of victims: excess past an attack on another victim over that past the own one"
    return [
        *rows,
        LedgerRow(line, round(share_kept(excess), 3), "x", "", None, COMMAND, f"{len(names)} victims, {of}"),
    ]


def claim_rows(claim: Mapping[str, Any]) -> list[LedgerRow]:
    """What the registered claim says: how many more drives leave the track, and how much more they err, than past the strongest baseline."""
    points = ", ".join(f"{each['victim']} {each['off_track_points']:+.0f}" for each in claim["each"])
    metres = ", ".join(f"{each['victim']} {each['difference_m']:+.3f}" for each in claim["each"])
    than = "the gradient's green screen than past the strongest baseline's"
    return [
        LedgerRow(f"panel of victims: more drives off the track past {than}", round(claim["off_track_points"]), "points", "", None, COMMAND, points),
        LedgerRow(f"panel of victims: more |CTE| past {than}, lower 95 % bound for new victims", round(claim["low_m"], 3), "m per tick", "", None, COMMAND, f"{claim['difference_m']:+.3f} m in the mean, to {claim['high_m']:+.3f}; {metres}"),
    ]  # fmt: skip


def ledger_rows() -> list[LedgerRow]:
    """The rows of the published claim, and of the kept drives."""
    (claim,) = read_json(_SET)["claims"]
    return [*claim_rows(claim), *rows_of(read_json(KEPT))]


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
    """Drive, or read what was driven, record the rows, and put numbers and picture into docs/."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument(
        "folder", type=Path, nargs="?", help="run folder of the searches; without one: the kept drives"
    )
    folder = parser.parse_args().folder
    if folder is not None:
        write_atomically(KEPT, json.dumps(drives_of(Experiment.resolved_in(folder.resolve()))) + "\n")
    found = read_json(KEPT)
    for row in ledger_rows():
        row.record()
        print(f"{row.line}: {row.value} {row.unit}; {row.note}")
    write_png(picture(found["victims"], excess_m(found), off_track(found)), _PICTURE, dpi=110)


if __name__ == "__main__":
    main()
