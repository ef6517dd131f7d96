"""Maps about a finished pose cell of the junction: the loss landscape over one object's place, and starts against moves of that object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from advnerf_core.attack.pose_maps import landscape, places_over, robustness_map, starts_beside
from advnerf_core.attack.pose_plots import draw_landscape, draw_robustness
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.attack.spaces.placed_sensor import PlacedSensor
from advnerf_core.attack.spaces.placement import PoseSpace
from advnerf_core.files import write_atomically
from advnerf_core.policies.pilotnet import LoadedPolicy
from nodes.experiment.junction.attack import attack_problem
from nodes.experiment.junction.cells import CellError
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.objects import placed_objects, surrogate_of
from nodes.experiment.junction.poses import PoseSettings, bounds_of, lanes_of, pose_hash
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
    object_moves_m: tuple[tuple[float, float], ...] = ((0.0, 0.0), (-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0))


def draw_maps(
    experiment: Experiment, victim: LoadedPolicy, scenario: str, seed: int, found: dict[str, Any], number: int, folder: Path,
    report: Report, poses: PoseSettings, settings: PoseMapSettings | None = None,
) -> list[Path]:  # fmt: skip
    """Drive over a grid of one object's places, and from starts beside its own past the object moved; in the learned scene.

    Args:
        experiment: Its scene and objects must be there.
        victim: Who was attacked.
        scenario: On which drive.
        seed: Whose starts.
        found: ``extra`` of the finished cell: the other objects stand, and all are coloured, as it found them.
        number: Of the object.
        folder: Gets ``landscape_<name>.json``, ``robustness_<name>.json`` and a PNG of each; finished points are kept there.
        report: Told the finished fraction.
        poses: Bounds of the cell.
        settings: What is mapped.

    Returns:
        The pictures.

    Raises:
        CellError: No such object, or a cell without an attack.
    """
    settings, count = settings or PoseMapSettings(), len(experiment.world.objects)
    if not 0 <= number < count:
        raise CellError(f"expected an object of 0 to {count - 1}, got {number}")
    if "placements" not in found:
        raise CellError(
            "expected a cell that has placed the objects, got one without attack; choose method random or gradient"
        )
    problem, theta = _problem(experiment, victim, scenario, seed, found, poses)
    digest = pose_hash(experiment, victim, scenario, seed, poses)
    sensor, name = problem.sensor, experiment.world.objects[number].name
    assert isinstance(sensor, PlacedSensor)
    place = sensor.placements(theta)[number]
    x_m, y_m = places_over(sensor.space, number, settings.points)
    flat = landscape(
        problem, theta, (x_m, y_m, (float(place[2]),)), number, folder / f"landscape_{name}.json", _half(report, 0.0, "landscape"), digest,
    )  # fmt: skip
    starts = starts_beside(problem.start_states[0, :3].tolist(), settings.sideways_m)
    moves = [(dx, dy, 0.0) for dx, dy in settings.object_moves_m]
    rough = robustness_map(
        problem, theta, starts, moves, number, folder / f"robustness_{name}.json", _half(report, 0.5, "starts x moves"), digest,
    )  # fmt: skip
    pictures = [folder / f"{what}_{name}.png" for what in ("landscape", "robustness")]
    marked = {"found": (float(place[0]), float(place[1]))}
    write_atomically(pictures[0], draw_landscape(flat, [experiment.paths[scenario]], marked))
    write_atomically(pictures[1], draw_robustness(rough))
    return pictures


def _problem(
    experiment: Experiment, victim: LoadedPolicy, scenario: str, seed: int, found: dict[str, Any], poses: PoseSettings
) -> tuple[AttackProblem, torch.Tensor]:
    """The cell's attack with free places, and what it found."""
    objects = placed_objects(experiment)
    surrogate = surrogate_of(experiment, objects)
    space = PoseSpace(objects, bounds_of(experiment.world.objects, poses), lanes_of(experiment))
    sensor = PlacedSensor(surrogate, space, True, None)
    colours = torch.tensor(found["colours"], dtype=surrogate.dtype)
    theta = sensor.join(space.unit(torch.tensor(found["placements"], dtype=torch.float64)), colours)
    problem = attack_problem(experiment, surrogate, victim, scenario, seed)
    return replace(problem, sensor=sensor), theta


def _half(report: Report, begin: float, what: str) -> Callable[[int, int], None]:
    return lambda done, count: report(begin + 0.5 * done / count, f"{what} {done}/{count}")
