"""Films of drives from the driver's seat: one per drive of an experiment's report, and one per cell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.attack.spaces.space import Space
from advnerf_core.documents import read_json
from advnerf_core.geometry import Array, planar_poses
from advnerf_core.policies.network import tensor_to_images
from advnerf_core.report.clips import ClipTrack, write_clip, write_film
from advnerf_core.report.conditions import NONE, compared, style_of
from advnerf_core.report.data import Film
from hardware.worlds.world import World
from nodes.experiment.engine.run_folder import SEARCHED
from nodes.experiment.plan.cell import Cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.attack import dress_cell, load_shown
from nodes.experiment.steps.deploy import DRIVES
from nodes.experiment.steps.keys import driven_folder
from nodes.lab.trials import evaluation

_FRAME_S = 0.1  # of films: finer ticks are not all filmed


def film_scenario(
    experiment: Experiment, scene: World | None, space: Space, scenario: str, folder: Path
) -> Film | None:
    """The drives without an attack, past the best random object and past the attacked one, side by side; first seed and start.

    Args:
        scene: The open scene; None for live drives, whose bags have the pictures, and if nothing was deployed: then the film
            shows the learned scene as the policy sees it.
    """
    _, rate_hz = filmed(experiment.config.dt_s)
    deployed, tracks = experiment.config.deploy.through != "nothing", []
    for method, title in compared(experiment.config.method_names).items():
        cell = Cell(scenario, experiment.config.main_victim, method, experiment.config.seeds[0])
        cell = cell.clean if method == NONE else cell
        driven = driven_folder(experiment, cell)
        if not deployed:
            tracks.append(_learned_track(experiment, space, cell, title, driven))
        elif (driven / DRIVES).exists():  # else not driven live
            tracks.append(_deployed_track(experiment, scene, space, cell, title, driven))
    return (
        write_film(folder / f"{scenario}.mp4", tracks, rate_hz, experiment.world.off_track_m)
        if tracks
        else None
    )


def film_cell(
    experiment: Experiment, scene: World | None, space: Space, cell: Cell, folder: Path, driven: Path
) -> Path:
    """The deployed drive of one cell, from its first start, as ``clip.mp4`` in ``folder``, unless it is there; its files are in the folder ``driven``."""
    film = folder / "clip.mp4"
    if film.exists():
        return film
    title = f"{style_of(cell.method).title}, {cell.victim}, seed {cell.seed}"
    track = _deployed_track(experiment, scene, space, cell, title, driven)
    _, rate_hz = filmed(experiment.config.dt_s)
    return write_clip(film, [track], rate_hz, experiment.world.off_track_m)


def _learned_track(experiment: Experiment, space: Space, cell: Cell, title: str, folder: Path) -> ClipTrack:
    """What the policy saw on the first drive of a cell in the learned scene."""
    every, _ = filmed(experiment.config.dt_s)
    states, shown = _states(folder / SEARCHED)[0][::every], load_shown(space, folder, cell)
    sensor = shown.seen_by(space.surrogate)
    poses = planar_poses(states) @ experiment.mount
    frames = [tensor_to_images(sensor.render(pose[None], shown.colours).images)[0] for pose in poses]
    return _track(experiment, cell, title, frames, states)


def _deployed_track(
    experiment: Experiment,
    scene: World | None,
    space: Space,
    cell: Cell,
    title: str,
    folder: Path,
) -> ClipTrack:
    """Images of the first deployed drive of a cell: rendered again by the open scene, or from the bag of a live drive."""
    every, _ = filmed(experiment.config.dt_s)
    file = folder / DRIVES
    states = _states(file)[0][::every]
    if scene is None:
        live = read_json(file)["live"][0]
        began_ns, period_s = live["outcome"]["start_real_ns"], every * experiment.config.dt_s
        views = list(evaluation.frames(folder / live["run"] / "bag", began_ns, len(states), period_s))
        note = live["outcome"]["stopped_early"] or "ended"
        return _track(experiment, cell, title, views, states, "".join(live["attack_ids"]), note)
    dressed, colours = dress_cell(experiment, scene, space, folder, cell)
    return _track(experiment, cell, title, [dressed.camera_image(state, colours) for state in states], states)


def filmed(dt_s: float) -> tuple[int, float]:
    """Number of ticks per frame, and the film's frames per second, so that it runs in real time."""
    every = max(1, round(_FRAME_S / dt_s))
    return every, 1.0 / (every * dt_s)


def _track(
    experiment: Experiment,
    cell: Cell,
    title: str,
    frames: list[NDArray[np.uint8]],
    states: Array,
    attack_id: str = "",
    note: str = "ended",
) -> ClipTrack:
    cte_m = experiment.paths[cell.scenario].project(np.asarray(states)[:, :2]).cte_m
    return ClipTrack(title, cell.method, frames, cte_m, attack_id, note)


def drives_of(experiment: Experiment, domain: str, cell: Cell) -> list[Array]:
    """States ``[T + 1, 3]`` of a cell's drives in one domain."""
    return _states(driven_folder(experiment, cell) / (SEARCHED if domain == "surrogate" else DRIVES))


def _states(file: Path) -> list[Array]:
    return [np.array(states)[:, :3] for states in read_json(file)["states"]]
