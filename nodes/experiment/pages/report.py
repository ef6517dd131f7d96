"""Stage report: the table of results, every drive from above and from the driver's seat, and the textures as seen."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from advnerf_core.attack.spaces.space import Shown, Space
from advnerf_core.documents import read_json
from advnerf_core.geometry import planar_poses
from advnerf_core.policies.network import tensor_to_images
from advnerf_core.report.cells import read_cell
from advnerf_core.report.conditions import NONE, style_of
from advnerf_core.report.data import ReportData
from advnerf_core.report.reference import DOMAINS
from advnerf_core.report.result_page import maximised_table, not_driven, text_table
from advnerf_core.report.result_table import ResultTable, make_table
from advnerf_core.report.targets import Target, evaluate, target_table
from advnerf_core.report.text_table import count
from hardware.worlds.world import World
from nodes.experiment.engine.run_folder import CELLS
from nodes.experiment.pages.gather import gather
from nodes.experiment.pages.opening import Wording, first_screen
from nodes.experiment.pages.table import wanted_rows, write_table
from nodes.experiment.plan.carriers import FaceCarrier
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.method_names import know_methods_of
from nodes.experiment.plan.object_kinds import name_of
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.overview import from_above
from nodes.experiment.show.spaces import make_space
from nodes.experiment.steps import films
from nodes.experiment.steps.attack import dress_cell, load_shown, planned_evaluations
from nodes.experiment.steps.keys import driven_folder
from nodes.runtime.console import plain_console
from nodes.runtime.progress import Report

PAGE = "report.html"
_TABLE_WIDTH = 160
# Points of a drive at which its objects are shown [m, at 6 m/s]: most of them are in view, some close.
_SEEN_AT_M = (9.0, 14.0)
# In the learned scene, of this many points of a drive those are shown where most of the objects is visible.
_LOOKED_AT, _SHOWN = 12, 2


def run(experiment: Experiment, folder: Path, report: Report, notes: Sequence[str] = ()) -> None:
    """Write ``report.html``, ``table.json``, ``table.csv``, ``table.md`` and a film of each drive; for live drives also measurements from their bags.

    All earlier stages, and all cells of the experiment's methods, are finished. Notes are paragraphs at the top of the page.
    """
    from advnerf_core.report.sections import page_sections  # matplotlib

    know_methods_of(experiment.folder / CELLS, experiment.config.method_names)
    data, table = _measure(experiment, folder, report), table_of(experiment)
    report(0.95, "writing the page")
    targets = evaluate(experiment.held_to.targets, table, data.measured)
    sections = page_sections(data, table)
    first = first_screen(data, table, experiment.config.main_victim, wording_of(experiment))
    cells = experiment.folder / CELLS
    write_table(table, cells, folder, sections, PAGE, targets, first=first, notes=notes)


def _measure(experiment: Experiment, folder: Path, report: Report) -> ReportData:
    """Cut films, and render the objects if the deployed world can be opened."""
    config, names = experiment.config, experiment.config.cell_paths
    filmed, seen, above = {}, {}, None
    with experiment.open_deployed_world() if config.deploy.through == "world" else nullcontext() as scene:
        space = make_space(experiment, scene)
        for index, name in enumerate(names):
            report(0.9 * index / len(names), f"filming {name}")
            filmed[name] = films.film_scenario(experiment, scene, space, name, folder)
            if scene is not None:
                seen[name] = textures_seen(experiment, scene, space, name)
            elif not config.deploy.live:
                seen[name] = seen_where_learned(experiment, space, name)
        above = None if scene is None else from_above(experiment, scene)
    return gather(experiment, filmed, seen, how_it_was_run(experiment), above)


def wording_of(experiment: Experiment) -> Wording:
    """Words for the attacked object and the place of the drives in the sentences of the page."""
    carrier, kinds = experiment.config.carrier, {thing.kind for thing in experiment.objects}
    thing = carrier.panel if isinstance(carrier, FaceCarrier) else "objects"
    if len(experiment.objects) == 1:
        thing = name_of(kinds.pop()).partition(".")[0].replace("_", " ")
    live = experiment.config.deploy.live
    where = "In the simulated lab" if live else f"In the world {experiment.deployed_world.kind}"
    return Wording(thing, where, experiment.limits.off_track_m)


def how_it_was_run(experiment: Experiment) -> str:
    """Summary of the experiment in one paragraph."""
    config, attack = experiment.config, experiment.config.attack
    methods = ", ".join(style_of(name).title for name in config.method_names)
    kinds = Counter(thing.kind.replace("_", " ") for thing in experiment.objects)
    named = " and ".join(count(number, kind) for kind, number in kinds.items())
    searched = (config.carrier if isinstance(config.carrier, FaceCarrier) else config.space).searched
    return (
        f"Policies ({', '.join(config.attacked)}) drive {', '.join(config.cell_paths)}. {searched.format(named)} ({methods}; {planned_evaluations(experiment)} evaluations "
        f"each, {count(len(config.seeds), 'seed')}, {count(attack.starts, 'start')}, {experiment.searched_ticks} ticks of {config.dt_s:g} s)"
        f"{_then(experiment)}. Drives last {config.horizon} ticks, from {count(config.measure.starts, 'start')} that no search used."
    )


def _then(experiment: Experiment) -> str:
    if experiment.config.deploy.live:
        return ", then shown to the driving car, frame by frame, by the live node graph"
    if experiment.config.deploy.through == "nothing":
        return "; nothing was driven in the place itself"
    return f", then put into the world {experiment.deployed_world.kind}"


def print_summary(experiment: Experiment, console: Console) -> None:
    """Print the table, its targets, and the path of the page."""
    wide = plain_console(
        file=console.file, width=max(console.width, _TABLE_WIDTH), force_terminal=console.is_terminal
    )
    table, folder = table_of(experiment), experiment.stage_folder("report")
    wide.print(text_table(table).rich())
    if (goals := maximised_table(table)) is not None:
        wide.print(goals.rich())
    if targets := [Target(**each) for each in read_json(folder / "table.json")["targets"]]:
        wide.print(target_table(targets).rich())
    if text := not_driven(table):
        console.print(text, highlight=False, markup=False, soft_wrap=True)
    console.print(f"report: {folder / PAGE}", highlight=False, soft_wrap=True)


def table_of(experiment: Experiment) -> ResultTable:
    """The table of all cells that this experiment itself has run."""
    plan = experiment.cells
    files = [experiment.cell_result(cell) for cell in plan]
    found = [read_cell(file) for file in files if file.exists()]
    domains = DOMAINS[:1] if experiment.config.deploy.through == "nothing" else DOMAINS
    return make_table(wanted_rows(plan), found, experiment.config.name, domains)


def textures_seen(
    experiment: Experiment, scene: World, space: Space, scenario: str
) -> dict[str, NDArray[np.uint8]]:
    """The same views of the driving camera past the plain, random and attacked objects of the first seed, one row each."""
    seed = experiment.config.seeds[0]
    reference = experiment.references[scenario]
    states = [np.array(reference.pose_at(experiment.along_m(at))) for at in _SEEN_AT_M]
    seen = {}
    for method in (NONE, *experiment.config.method_names):
        cell = Cell(scenario, experiment.config.main_victim, method, seed)
        dressed, colours = dress_cell(experiment, scene, space, driven_folder(experiment, cell), cell)
        seen[method] = np.concatenate([dressed.camera_image(state, colours) for state in states], axis=1)
    return seen


def seen_where_learned(experiment: Experiment, space: Space, scenario: str) -> dict[str, NDArray[np.uint8]]:
    """Policy images in the learned scene past the plain, random and attacked objects of the first seed, where most of them is in view."""
    victim, seed = experiment.config.main_victim, experiment.config.seeds[0]
    driven = films.drives_of(experiment, "surrogate", Cell(scenario, victim, NONE, 0))[0]
    states = driven[np.linspace(0, len(driven) - 1, min(_LOOKED_AT, len(driven))).astype(int)]
    poses = planar_poses(states) @ experiment.mount

    def rendered(shown: Shown) -> torch.Tensor:
        return shown.seen_by(space.surrogate).render(poses, shown.colours).images

    changed = (rendered(space.plain) - rendered(Shown((), torch.zeros(0, 3)))).abs().sum(dim=(1, 2, 3))
    best = changed.argsort(descending=True, stable=True)[:_SHOWN].sort().values
    seen = {}
    for method in (NONE, *experiment.config.method_names):
        cell = Cell(scenario, victim, method, 0 if method == NONE else seed)
        pictures = rendered(load_shown(space, driven_folder(experiment, cell), cell))[best]
        seen[method] = np.concatenate(tensor_to_images(pictures), axis=1)
    return seen
