"""Films of drives from the driver's seat: one per drive of an experiment's report, and one per cell of a campaign."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.attack.spaces.space import Shown, Space
from advnerf_core.geometry import Array, planar_poses
from advnerf_core.report.clips import ClipTrack, write_clip
from advnerf_core.report.conditions import NONE, style_of
from advnerf_core.scene.surrogate import Surrogate
from hardware.worlds.world import World
from nodes.experiment.images import as_uint8
from nodes.experiment.junction.attack import Cell, load_shown
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.deployed import DressedScene
from nodes.experiment.junction.policy import HARDENED
from nodes.experiment.learned_scene import load_background

DOMAINS = ("surrogate", "deployed")
_FRAME_S = 0.1  # of films: finer ticks are not all filmed


def strongest(experiment: Experiment) -> str:
    """The method that films show: the gradient if it was searched."""
    methods = experiment.config.attack.method_names
    return "gradient" if "gradient" in methods else methods[-1]


def film_scenario(experiment: Experiment, scene: World, space: Space, scenario: str, folder: Path) -> Path:
    """The attacked drive in the surrogate, and the deployed ones past plain and attacked objects, side by side; first seed and start."""
    seed, method = experiment.config.attack.seeds[0], strongest(experiment)
    attacked = Cell(scenario, HARDENED, method, seed)
    shown = load_shown(space, experiment.stage_folder("attack"), attacked)
    whole = Surrogate(load_background(experiment), experiment.camera, experiment.mount, shown.objects)
    every, rate_hz = filmed(experiment.config.dt_s)
    learned = drives_of(experiment, "surrogate", attacked)[0][::every]
    poses = planar_poses(learned) @ experiment.mount
    frames = [as_uint8(whole.render(pose[None], shown.colours).images[0]) for pose in poses]
    tracks = [_track(experiment, scenario, "learned scene, attacked", method, frames, learned)]
    for cell, there in ((attacked.clean, space.plain), (attacked, shown)):
        states = drives_of(experiment, "deployed", cell)[0][::every]
        dressed = DressedScene(scene, experiment.view, there.objects)
        views = [dressed.camera_image(state, there.colours) for state in states]
        title = "deployed, no attack" if cell.method == NONE else "deployed, attacked"
        tracks.append(_track(experiment, scenario, title, cell.method, views, states))
    return write_clip(folder / f"{scenario}.mp4", tracks, rate_hz, experiment.world.off_track_m)


def film_cell(experiment: Experiment, scene: World, shown: Shown, cell: Cell, folder: Path) -> Path:
    """The deployed drive of one cell, from its first start; its files are in ``folder``, and ``clip.mp4`` will be."""
    every, rate_hz = filmed(experiment.config.dt_s)
    states = _states(folder / f"{cell.name}.drives.json")[0][::every]
    dressed = DressedScene(scene, experiment.view, shown.objects)
    views = [dressed.camera_image(state, shown.colours) for state in states]
    title = f"{style_of(cell.method).title}, {cell.victim}, seed {cell.seed}"
    track = _track(experiment, cell.scenario, title, cell.method, views, states)
    return write_clip(folder / "clip.mp4", [track], rate_hz, experiment.world.off_track_m)


def kept_film(folder: Path) -> Path | None:
    """The film of a cell in its folder; None where there is none yet."""
    return next(folder.glob("clip.*"), None)


def with_film(data: dict[str, Any], film: Path) -> dict[str, Any]:
    """The cell with the name of its film, relative to the folder of all cells."""
    return {**data, "extra": {**data["extra"], "clip": f"{film.parent.name}/{film.name}"}}


def filmed(dt_s: float) -> tuple[int, float]:
    """Every how many ticks a frame is taken, and the film's frames per second, so that it runs in real time."""
    every = max(1, round(_FRAME_S / dt_s))
    return every, 1.0 / (every * dt_s)


def _track(
    experiment: Experiment,
    scenario: str,
    title: str,
    method: str,
    frames: list[NDArray[np.uint8]],
    states: Array,
) -> ClipTrack:
    cte_m = experiment.paths[scenario].project(np.asarray(states)[:, :2]).cte_m
    return ClipTrack(title, method, frames, cte_m)


def drives_of(experiment: Experiment, domain: str, cell: Cell) -> list[Array]:
    """States ``[T + 1, 3]`` of a cell's drives in one domain."""
    stage, suffix = ("attack", "json") if domain == "surrogate" else ("deploy", "drives.json")
    return _states(experiment.stage_folder(stage) / f"{cell.name}.{suffix}")


def _states(file: Path) -> list[Array]:
    return [np.array(states)[:, :3] for states in json.loads(file.read_text())["states"]]
