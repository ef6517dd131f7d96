"""Maps about a finished pose cell of the junction: the loss landscape over one object's place, and starts against moves of that object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from advnerf_core.attack.artifact import AttackFile
from advnerf_core.attack.pose_maps import landscape, places_over, robustness_map, starts_beside
from advnerf_core.attack.pose_plots import draw_landscape, draw_robustness
from advnerf_core.attack.spaces.placed_sensor import PlacedSensor
from advnerf_core.files import write_atomically
from nodes.experiment.plan.cell import Cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.spaces import make_space
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import attack_problem
from nodes.runtime.progress import Report


@dataclass(frozen=True)
class PoseMapSettings:
    """What is mapped.

    Attributes:
        points: Of the landscape, along x and y of the object's bounds.
        sideways_m: Starts of the map, to the left of the cell's first one [m].
        object_moves_m: Moves of the object along x and y [m].
    """

    points: tuple[int, int] = (9, 9)
    sideways_m: tuple[float, ...] = (-0.6, -0.3, 0.0, 0.3, 0.6)
    object_moves_m: tuple[tuple[float, float], ...] = (
        (0.0, 0.0),
        (-1.0, 0.0),
        (1.0, 0.0),
        (0.0, -1.0),
        (0.0, 1.0),
    )


def draw_maps(
    experiment: Experiment,
    cell: Cell,
    attack: AttackFile,
    number: int,
    folder: Path,
    report: Report,
    settings: PoseMapSettings | None = None,
) -> list[Path]:
    """Drive over a grid of one object's places, and from starts beside its own past the object moved; in the learned scene.

    Args:
        experiment: Experiment with finished scene and objects, whose space is places.
        cell: The finished cell.
        attack: Attack of the cell: the other objects keep its places, and all keep its colours.
        number: Number of the moved object.
        folder: Folder for ``landscape_<name>.json``, ``robustness_<name>.json`` and a PNG of each; it also stores finished points.
        report: Told the finished fraction.
        settings: What is mapped.

    Returns:
        The pictures.
    """
    settings = settings or PoseMapSettings()
    space = make_space(experiment, None)
    sensor, name = space.sensor, experiment.objects[number].name
    assert isinstance(sensor, PlacedSensor), "the space of places has this sensor"
    victim = load_victim(experiment, cell.victim)
    problem = attack_problem(experiment, space, victim, cell.scenario, cell.seed)
    places = torch.tensor([each.placement for each in attack.objects], dtype=torch.float64)
    # In the unit box also where only the plain colours are meant.
    theta = sensor.join(sensor.space.unit(places), space.restored(attack).colours)
    place = sensor.placements(theta)[number]
    x_m, y_m = places_over(sensor.space, number, settings.points)
    digest = attack.sha256
    flat = landscape(
        problem,
        theta,
        (x_m, y_m, (float(place[2]),)),
        number,
        folder / f"landscape_{name}.json",
        _half(report, 0.0, "landscape"),
        digest,
    )
    starts = starts_beside(problem.start_states[0, :3].tolist(), settings.sideways_m)
    moves = [(dx, dy, 0.0) for dx, dy in settings.object_moves_m]
    rough = robustness_map(
        problem,
        theta,
        starts,
        moves,
        number,
        folder / f"robustness_{name}.json",
        _half(report, 0.5, "starts x moves"),
        digest,
    )
    pictures = [folder / f"{what}_{name}.png" for what in ("landscape", "robustness")]
    marked = {"found": (float(place[0]), float(place[1]))}
    write_atomically(pictures[0], draw_landscape(flat, [experiment.paths[cell.scenario]], marked))
    write_atomically(pictures[1], draw_robustness(rough))
    return pictures


def _half(report: Report, begin: float, what: str) -> Callable[[int, int], None]:
    return lambda done, count: report(begin + 0.5 * done / count, f"{what} {done}/{count}")
