"""Cells of a campaign in which the objects are moved as well: kind ``intersection_poses``, see `nodes/experiment/junction/poses.py`.

A scenario's ``set`` may change `PoseSettings` (``poses.colours=false`` moves the objects in their plain colours). The victim ``retrained`` is
the policy after the first round of the experiment's stage retrain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from advnerf_core.policies.pilotnet import load_policy
from nodes.experiment.junction import pose_maps, run
from nodes.experiment.junction.attack import Cell
from nodes.experiment.junction.cell_settings import inputs_of, load_with
from nodes.experiment.junction.cells import require_known
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.deployed import DressedScene
from nodes.experiment.junction.films import film_again, kept_film, with_film
from nodes.experiment.junction.policy import attackable, victim_file
from nodes.experiment.junction.poses import PoseMethod, PoseSettings, found_colours, found_objects, pose_cell, pose_hash
from nodes.runtime.progress import Report

METHODS: tuple[PoseMethod, ...] = ("none", "random", "gradient")
prepare = run.prepare_victims
UNPUBLISHED = ("colours",)  # six megabytes a cell; maps read them in the campaign's folder
PREDICTS = False  # what a prediction composes into real pictures stands where it was placed by hand


@dataclass(frozen=True)
class PoseExperiment(Experiment):
    """The experiment, and how far its objects may be moved.

    Attributes:
        poses: Bounds and budget.
    """

    poses: PoseSettings = field(default_factory=PoseSettings)


def load_experiment(file: Path, setting: str, overrides: Sequence[str], folder: Path) -> PoseExperiment:
    """Read the experiment, and the scenario's changes ``poses.*``."""
    return load_with(PoseExperiment, PoseSettings, "poses", file, setting, overrides, folder)


def cell_inputs(experiment: PoseExperiment, scenario: str, victim: str, method: str, seed: int) -> dict[str, Any]:
    """What a cell depends on; not known before there are scene, objects and victim."""
    require_known(experiment, scenario, attackable(experiment), victim, method, METHODS)

    def digest() -> str:
        return pose_hash(experiment, load_policy(victim_file(experiment, victim)), scenario, seed, experiment.poses)

    return inputs_of(experiment, victim, digest)


def draw_maps(
    experiment: PoseExperiment, scenario: str, victim: str, seed: int, found: dict[str, Any], number: int, folder: Path, report: Report
) -> list[Path]:  # fmt: skip
    """Loss landscape and robustness map of a finished cell; see `nodes/experiment/junction/pose_maps.py`."""
    policy = load_policy(victim_file(experiment, victim))
    return pose_maps.draw_maps(experiment, policy, scenario, seed, found, number, folder, report, experiment.poses)


def run_cell(
    experiment: PoseExperiment, scenario: str, victim: str, method: PoseMethod, seed: int, folder: Path, report: Report
) -> dict[str, Any]:
    """Search for places (and colours), drive in both domains, film the first deployed drive; see `pose_cell`."""
    require_known(experiment, scenario, attackable(experiment), victim, method, METHODS)
    policy = load_policy(victim_file(experiment, victim))
    with experiment.site.open() as scene:
        data = pose_cell(experiment, policy, scenario, method, seed, folder, report, scene, experiment.poses)
        if (film := kept_film(folder)) is None:
            dressed = DressedScene(scene, experiment.view, found_objects(experiment, data["extra"]))
            colours = found_colours(data["extra"], dressed)
            film = film_again(experiment, dressed, Cell(scenario, victim, method, seed), policy.policy, colours, folder)
    # As of all cells, the time of the search: none without one.
    return with_film({**data, "seconds": data["extra"].get("seconds", 0.0)}, film)
