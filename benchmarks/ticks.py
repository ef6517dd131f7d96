"""How long a tick of the surrogate and an iteration of an attack take in a run folder: printed as JSON, for `benchmarks.baked_scene`.

It names nothing that the code of before baked scenes lacks, so that the same script measures both.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

from advnerf_core.documents import read_json

import advnerf_core as advnerf_core  # isort: skip  # before torch, as in the commands
import numpy as np
import torch

from advnerf_core.attack.adjoint import adjoint_gradient
from advnerf_core.driving.rollout import drive
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import make_transform, planar_poses, rotation_z
from advnerf_core.objects.voxel.build import build_from_mesh
from advnerf_core.objects.voxel.generators import GENERATORS
from advnerf_core.objects.voxel.mesh import stand
from advnerf_core.scene.surrogate import Surrogate
from benchmarks.timing import seconds_in_turns
from nodes.experiment.plan.config import ExperimentConfig
from nodes.experiment.plan.victims import HARDENED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.faces import has_face
from nodes.experiment.show.learned_scene import load_background
from nodes.experiment.show.spaces import make_space
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import attack_problem

STEPS, OBJECTS = 40, (1, 5)


def _run_of(folder: Path) -> Experiment:
    """The experiment of a run folder, as it was run."""
    manifest = read_json(folder / "manifest.json")
    config = ExperimentConfig.model_validate(manifest["config"])
    return Experiment(config, Path(manifest["file"]), folder.resolve(), manifest["setting"])


def hydrants(count: int) -> list[VoxelGridObject]:
    """Hydrants of 64^3 side by side at the corner that the car comes to."""
    model = build_from_mesh(stand(GENERATORS["hydrant"]()), "hydrant", 64, 0, {})
    places = [make_transform(rotation_z(0.3 * k), [2.6, -1.9 + 0.45 * k, 0.0]) for k in range(count)]
    return [model.placed(place, 1.0) for place in places]


def measured(folder: Path, repeats: int = 5) -> dict[str, float]:
    """Milliseconds of ticks before the room's scene, and of an iteration on whatever the experiment attacks."""
    experiment = _run_of(folder)
    in_room = has_face(experiment)
    return {**(_ticks(experiment, repeats) if in_room else {}), "iteration": _iteration(experiment, repeats)}


def _ticks(experiment: Experiment, repeats: int) -> dict[str, float]:
    """Of a tick of a rollout with one object and with five (scene, objects, policy, car, 200 x 66)."""
    scenario, background = experiment.config.paths[0], load_background(experiment)
    path, loaded = experiment.paths[scenario], load_victim(experiment, HARDENED)
    states = np.array([path.pose_at(float(s)) for s in np.linspace(0.0, 3.0, 30)])
    poses, found = planar_poses(states) @ experiment.mount, {}
    start = torch.zeros(1, experiment.dynamics.state_size)
    for count in OBJECTS:
        surrogate = Surrogate(background, experiment.view.pinhole, experiment.mount, hydrants(count))
        theta = surrogate.plain_theta()

        def along_the_path(surrogate: Surrogate = surrogate, theta: torch.Tensor = theta) -> None:
            # The same views for both codes, wherever their policies would drive.
            views = (surrogate.render(pose[None], theta).images for pose in poses)
            drive(loaded.policy, lambda _: next(views), experiment.dynamics, start, len(poses))

        found[f"tick, {count}"] = (
            1e3 * seconds_in_turns({"tick": along_the_path}, repeats)["tick"] / len(poses)
        )
    return found


def _iteration(experiment: Experiment, repeats: int) -> float:
    """Of a rollout and its gradient."""
    scenario, space = experiment.config.paths[0], make_space(experiment, None)
    loaded = load_victim(experiment, HARDENED)
    problem = replace(attack_problem(experiment, space, loaded, scenario, 0), steps=STEPS)
    theta = space.surrogate.initial_theta(torch.Generator().manual_seed(0))
    return (
        1e3 * seconds_in_turns({"iteration": lambda: adjoint_gradient(problem, theta)}, repeats)["iteration"]
    )


if __name__ == "__main__":
    print(json.dumps(measured(Path(sys.argv[1]))))
