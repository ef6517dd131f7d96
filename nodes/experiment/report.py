"""Stage report: the transfer table, what every drive did from above and from the driver's seat, and the textures as they were seen."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from advnerf_core.attack.spaces.space import Space
from advnerf_core.files import write_atomically
from advnerf_core.report.conditions import NONE, order_of, style_of
from advnerf_core.report.tables import Table, spread
from hardware.worlds.world import World
from nodes.experiment import films, live_report, page
from nodes.experiment.attack import cells, load_found, load_shown
from nodes.experiment.cell import Cell
from nodes.experiment.context import Experiment
from nodes.experiment.keys import driven_folder
from nodes.experiment.overview import from_above
from nodes.experiment.policy import HARDENED
from nodes.experiment.spaces import dress, make_space, shown_there
from nodes.runtime.progress import Report

# Where along a drive its objects are shown [m, at 6 m/s]: most of them are in view, some close.
_SEEN_AT_M = (9.0, 14.0)


@dataclass(frozen=True)
class Row:
    """Drives of one domain, scenario, victim and method, over seeds and starts.

    Attributes:
        domain: surrogate or deployed.
        scenario: straight, right or left.
        victim: hardened or naive.
        method: none, or the name of a method of attack.
        total_cte_m: Total CTE of each drive [m].
        ratios: Each over the drive past the plain objects from the same start in the same domain.
        off_track: Drives that left the lane.
    """

    domain: str
    scenario: str
    victim: str
    method: str
    total_cte_m: tuple[float, ...]
    ratios: tuple[float, ...]
    off_track: int

    @property
    def ratio(self) -> float:
        """Sum over sum, so that a start that is driven without error does not decide."""
        clean = sum(total / ratio for total, ratio in zip(self.total_cte_m, self.ratios, strict=True))
        return sum(self.total_cte_m) / clean


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write ``report.html``, ``results.json``, ``results.csv`` and a clip of each drive."""
    if experiment.config.deploy.live:
        live_report.run(experiment, folder, report)
        return
    rows = rows_of(experiment)
    table = transfer_table(rows)
    write_results(experiment, rows, folder)
    clips = []
    with experiment.open_world() as scene:
        space = make_space(experiment, scene)
        overview = from_above(experiment, scene)
        for index, name in enumerate(experiment.config.scenarios):
            report(0.1 + 0.8 * index / len(experiment.config.scenarios), f"filming {name}")
            clips.append(films.film_scenario(experiment, scene, space, name, folder))
        seen: dict[str, dict[str, NDArray[np.uint8]]] = {
            name: textures_seen(experiment, scene, space, name) for name in experiment.config.scenarios
        }
    report(0.95, "writing the page")
    page.write(experiment, folder, table, overview, clips, seen)


def print_summary(experiment: Experiment, console: Console) -> None:
    """The transfer table, and where the page is."""
    if experiment.config.deploy.live:
        live_report.print_summary(experiment, console)
        return
    console.print(transfer_table(rows_of(experiment)).rich())
    console.print(
        f"report: {experiment.stage_folder('report') / 'report.html'}", highlight=False, soft_wrap=True
    )


def read_cell(experiment: Experiment, cell: Cell) -> dict[str, Any]:
    """A finished cell."""
    found: dict[str, Any] = json.loads(experiment.cell_result(cell).read_text())
    return found


def rows_of(experiment: Experiment) -> list[Row]:
    """The transfer table's rows, from all finished cells."""
    drives: dict[tuple[str, str, str, str], list[tuple[float, float, bool]]] = {}
    for cell in cells(experiment):
        data = read_cell(experiment, cell)
        for domain in films.DOMAINS:
            part = data[domain]
            kept = drives.setdefault((cell.victim, cell.scenario, domain, cell.method), [])
            kept += zip(part["total_cte_m"], part["none_total_cte_m"], part["off_track"], strict=True)
    rows = []
    for (victim, scenario, domain, method), found in sorted(
        drives.items(), key=lambda item: _order(experiment, item[0])
    ):
        totals = tuple(total for total, _, _ in found)
        ratios = tuple(total / max(clean, 1e-9) for total, clean, _ in found)
        rows.append(Row(domain, scenario, victim, method, totals, ratios, sum(off for _, _, off in found)))
    return rows


def _order(experiment: Experiment, key: tuple[str, str, str, str]) -> tuple[bool, int, int, tuple[int, str]]:
    victim, scenario, domain, method = key
    place = experiment.config.scenarios.index(scenario), films.DOMAINS.index(domain)
    return (victim != HARDENED, *place, order_of(method))


def transfer_table(rows: Sequence[Row]) -> Table:
    """The rows as text."""
    texts, groups, before = [], [], ("", "", "")
    for index, row in enumerate(rows):
        here = (row.victim, row.scenario, row.domain)
        if here != before:
            groups.append(index)
        first = tuple(now if here != before else "" for now in here)
        std = float(np.std(row.total_cte_m, ddof=1)) if len(row.total_cte_m) > 1 else None
        ratio_std = float(np.std(row.ratios, ddof=1)) if len(row.ratios) > 1 else None
        texts.append(
            (
                *first,
                style_of(row.method).title,
                str(len(row.total_cte_m)),
                spread(float(np.mean(row.total_cte_m)), std),
                "" if row.method == NONE else spread(row.ratio, ratio_std),
                f"{row.off_track} of {len(row.total_cte_m)}",
            )
        )
        before = here
    columns = (
        "victim",
        "drive",
        "domain",
        "objects show",
        "runs",
        "total CTE [m]",
        "over no attack",
        "off-track",
    )
    return Table(
        "Total CTE: surrogate and deployed", columns, tuple(texts), (False,) * 4 + (True,) * 4, tuple(groups)
    )


def write_results(experiment: Experiment, rows: Sequence[Row], folder: Path) -> None:
    """All cells as JSON, and the table as CSV."""
    kept = {
        "setting": experiment.setting,
        "cells": [read_cell(experiment, cell) for cell in cells(experiment)],
    }
    write_atomically(folder / "results.json", json.dumps(kept, indent=1) + "\n")
    lines = ["victim,scenario,domain,method,runs,total_cte_mean_m,total_cte_std_m,ratio,off_track"]
    for row in rows:
        std = np.std(row.total_cte_m, ddof=1) if len(row.total_cte_m) > 1 else float("nan")
        numbers = (
            f"{len(row.total_cte_m)},{np.mean(row.total_cte_m):.4f},{std:.4f},{row.ratio:.4f},{row.off_track}"
        )
        lines.append(f"{row.victim},{row.scenario},{row.domain},{row.method},{numbers}")
    write_atomically(folder / "results.csv", "\n".join(lines) + "\n")


def textures_seen(
    experiment: Experiment, scene: World, space: Space, scenario: str
) -> dict[str, NDArray[np.uint8]]:
    """The same views of the driving camera past the plain, random and attacked objects of the first seed, one row each."""
    seed = experiment.config.attack.seeds[0]
    reference = experiment.references[scenario]
    states = [np.array(reference.pose_at(experiment.along_m(at))) for at in _SEEN_AT_M]
    seen = {}
    for method in (NONE, *experiment.config.attack.method_names):
        cell = Cell(scenario, HARDENED, method, seed)
        folder = driven_folder(experiment, cell)
        shown = load_shown(space, folder, cell)
        dressed, colours = dress(experiment, scene, shown), shown_there(shown, load_found(folder, cell))
        seen[method] = np.concatenate([dressed.camera_image(state, colours) for state in states], axis=1)
    return seen
