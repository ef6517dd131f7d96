"""Maps about the result of a search of places: the loss landscape over one object's place, and starts against moves of that object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from advnerf_core.attack.artifact import load_attack
from advnerf_core.attack.pose_maps import (
    PoseMapError,
    landscape,
    places_over,
    robustness_map,
    starts_beside,
)
from advnerf_core.attack.pose_plots import draw_landscape, draw_robustness
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.attack.search.poses import placed_sensor
from advnerf_core.files import write_atomically
from nodes.experiment.engine.run_folder import ATTACK
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.space_config import LandscapeConfig, MapsConfig, PlacesConfig, RobustnessMapConfig
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.spaces import make_space
from nodes.experiment.steps.attack import Prepared
from nodes.experiment.steps.keys import NoSuchCellError
from nodes.runtime.progress import Report


@dataclass(frozen=True, eq=False)
class Mapped:
    """The state that maps start from.

    Attributes:
        problem: The attack problem, with a `PlacedSensor`.
        theta: Places and colours of all objects.
        digest: Hash of everything that must not change between a map and its file.
        mark: Label of the object's place in ``theta`` in the landscape; empty for no mark.
    """

    problem: AttackProblem
    theta: Tensor
    digest: str
    mark: str = ""

    def draw(self, maps: MapsConfig, number: int, folder: Path, report: Report, name: str = "") -> list[Path]:
        """Drive over a grid of one object's places, and from starts beside the first one past the object moved.

        Args:
            number: Number of the moved object.
            folder: For ``landscape.json``, ``robustness.json``, which keep finished points, and a PNG of each.
            name: Ending of their names.

        Returns:
            The pictures.

        Raises:
            PoseMapError: The object does not exist, or a file holds another map.
        """
        flat, rough = folder / f"landscape{name}.json", folder / f"robustness{name}.json"
        return [
            self._landscape(maps.landscape, number, flat, _half(report, 0.0, "landscape")),
            self._robustness(maps.robustness, number, rough, _half(report, 0.5, "starts x moves")),
        ]

    def _landscape(self, wanted: LandscapeConfig, number: int, file: Path, report: Report) -> Path:
        sensor = placed_sensor(self.problem)
        places = sensor.placements(self.theta)
        if number >= len(places):
            raise PoseMapError(f"expected an object of 0..{len(places) - 1}, got {number}")
        place = places[number]
        x_m, y_m = places_over(sensor.space, number, wanted.points)
        grid = (x_m, y_m, wanted.yaws_rad or (float(place[2]),))
        found = landscape(self.problem, self.theta, grid, number, file, _telling(report), self.digest)
        marked = {self.mark: (float(place[0]), float(place[1]))} if self.mark else None
        picture = file.with_suffix(".png")
        write_atomically(picture, draw_landscape(found, [self.problem.path], marked))
        return picture

    def _robustness(self, wanted: RobustnessMapConfig, number: int, file: Path, report: Report) -> Path:
        starts = starts_beside(self.problem.start_states[0, :3].tolist(), wanted.sideways_m, wanted.turn_rad)
        moves = [(dx, dy, turn) for turn in wanted.object_turns_rad for dx, dy in wanted.object_moves_m]
        found = robustness_map(
            self.problem, self.theta, starts, moves, number, file, _telling(report), self.digest
        )
        picture = file.with_suffix(".png")
        write_atomically(picture, draw_robustness(found))
        return picture


def draw_maps(experiment: Experiment, cell: Cell, number: int, folder: Path, report: Report) -> list[Path]:
    """Both maps about a finished cell, in the learned scene: the other objects keep the places of its attack, and all keep its colours.

    Args:
        number: Number of the moved object.
        folder: Folder of the cell; see `Mapped.draw`.

    Returns:
        The pictures; none for a cell that moved no object.

    Raises:
        NoSuchCellError: The cell has no object of this number.
    """
    if not is_mapped(experiment, cell, number):
        return []
    attack = load_attack(folder / ATTACK)
    space, name, maps = make_space(experiment, None), experiment.objects[number].name, experiment.config.maps
    problem = Prepared.of(experiment, space, cell).problem
    sensor = placed_sensor(problem)
    places = torch.tensor([each.placement for each in attack.objects], dtype=torch.float64)
    # In the unit box even if only the plain colours are used.
    theta = sensor.join(sensor.space.unit(places), space.restored(attack).colours)
    return Mapped(problem, theta, attack.sha256, "found").draw(maps, number, folder, report, f"_{name}")


def is_mapped(experiment: Experiment, cell: Cell, number: int) -> bool:
    """Whether a cell moved objects.

    Raises:
        NoSuchCellError: It has no object of this number.
    """
    if not cell.searched or not isinstance(experiment.config.space, PlacesConfig):
        return False
    count = len(experiment.objects)
    if not 0 <= number < count:
        raise NoSuchCellError(f"expected an object of 0 to {count - 1}, got {number}")
    return True


def _telling(report: Report) -> Callable[[int, int], None]:
    return lambda done, count: report(done / count, f"{done}/{count} cells")


def _half(report: Report, begin: float, what: str) -> Report:
    return lambda fraction, text="": report(begin + 0.5 * fraction, f"{what} {text}")
