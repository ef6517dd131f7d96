"""Cells of a campaign whose objects are meshes: kind ``intersection_meshes``, see `nodes/experiment/junction/meshes.py`.

A scenario's ``set`` may change `MeshSettings` (``meshes.target=shape``, ``meshes.limits.bound_m=1.0``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from advnerf_core.policies.pilotnet import load_policy
from nodes.experiment.junction import run
from nodes.experiment.junction.attack import Cell
from nodes.experiment.junction.cell_settings import inputs_of, load_with
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.deployed import DressedScene
from nodes.experiment.junction.films import film_again, kept_film, with_film
from nodes.experiment.junction.meshes import MeshSettings, found_meshes, mesh_cell, mesh_hash, require_cell
from nodes.experiment.junction.policy import victim_file
from nodes.runtime.progress import Report

FIDELITY = None  # the frames are the deployment scene's own: there is no learned scene to judge
prepare = run.prepare_victims


@dataclass(frozen=True)
class MeshExperiment(Experiment):
    """The experiment, and what is attacked of its meshes.

    Attributes:
        meshes: Textures or shapes, and how far they may go.
    """

    meshes: MeshSettings = field(default_factory=MeshSettings)


def load_experiment(file: Path, setting: str, overrides: Sequence[str], folder: Path) -> MeshExperiment:
    """Read the experiment, and the scenario's changes ``meshes.*``."""
    return load_with(MeshExperiment, MeshSettings, "meshes", file, setting, overrides, folder)


def cell_inputs(experiment: MeshExperiment, scenario: str, victim: str, method: str, seed: int) -> dict[str, Any]:
    """What a cell depends on; not known before there is a victim."""
    require_cell(experiment, scenario, victim, method, experiment.meshes)
    return inputs_of(experiment, victim, lambda: mesh_hash(experiment, scenario, victim, seed, experiment.meshes))


def run_cell(
    experiment: MeshExperiment, scenario: str, victim: str, method: str, seed: int, folder: Path, report: Report
) -> dict[str, Any]:
    """Search over the deployment scene's frames, drive there; see `mesh_cell`. The film is past the objects as they were exported."""
    data = mesh_cell(experiment, scenario, victim, method, seed, folder, report, experiment.meshes)
    if (film := kept_film(folder)) is None:
        fields = found_meshes(experiment, scenario, victim, method, seed, folder, experiment.meshes)
        policy = load_policy(victim_file(experiment, victim)).policy
        with experiment.site.open() as scene:
            dressed = DressedScene(scene, experiment.view, fields)
            cell = Cell.of(scenario, victim, method, seed)
            film = film_again(experiment, dressed, cell, policy, dressed.plain_theta(), folder)
    return with_film(data, film)
