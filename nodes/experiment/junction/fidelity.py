"""Real and learned pictures of the junction, without and with an attack: what the fidelity gate and the prediction of transfer look at.

Real pictures are the deployment scene's, with the opaque objects composed by depth, from where the car was on its drive past the plain
objects. No drive with the attack is looked at.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.data.dataset import load_transforms
from advnerf_core.driving.metrics import Horizon
from advnerf_core.policies.pilotnet import load_policy
from advnerf_core.scene.fidelity import Pictures
from nodes.experiment.images import as_uint8
from nodes.experiment.junction import capture
from nodes.experiment.junction.attack import Cell, attack_path, attack_problem, load_shown
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.deployed import DressedScene
from nodes.experiment.junction.drives import deployed_drives
from nodes.experiment.junction.objects import placed_objects, surrogate_of
from nodes.experiment.junction.policy import victim_file
from nodes.experiment.junction.run import stages_of
from nodes.experiment.junction.spaces import colour_space
from nodes.experiment.stages import is_current
from nodes.runtime.errors import RuntimeFault

Rgb = NDArray[np.uint8]


def policy_of(experiment: Experiment, victim: str, scenario: str) -> tuple[Any, tuple[float, ...]]:
    """The victim and the exit that it is told."""
    return load_policy(victim_file(experiment, victim)).policy, experiment.goal(scenario)


def held_out(experiment: Experiment, scenario: str) -> Pictures:
    """The driving camera's views that nothing was learned from, about all drives, without objects."""
    del scenario
    views = load_transforms(experiment.stage_folder("capture") / capture.HELD_OUT, require_all=True).load()
    surrogate = surrogate_of(experiment, [])
    learned = [as_uint8(surrogate.render(pose[None], None).images[0]) for pose in views.T_world_from_camera]
    return Pictures(
        "held-out views", np.stack([experiment.view.image(rgb) for rgb in views.rgb]), np.stack(learned)
    )


def driven(
    experiment: Experiment, scenario: str, victim: str, seed: int, folder: Path, bag: Path | None = None
) -> Pictures:
    """What the camera sees on the deployed drive past the plain objects; the scene is asked for it, there is no bag."""
    del folder
    if bag is not None:
        raise RuntimeFault(
            "expected no bag for a junction, whose drives are asked of the scene; leave --bag out"
        )
    return _along_the_drive(experiment, scenario, victim, seed, None, "drive past the plain objects")


def lacks(experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path) -> str:
    """What a prediction still needs, in words; empty if all is there."""
    found = _searched_in(experiment, Cell.of(scenario, victim, method, seed), folder)
    return "" if found is not None else "its search"


def attacked(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path
) -> Pictures:
    """The same places with the colours of a finished search."""
    theta = _theta(experiment, scenario, victim, method, seed, folder)
    return _along_the_drive(experiment, scenario, victim, seed, theta, "the same drive, attacked")


def loop(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path
) -> tuple[AttackProblem, Callable[[torch.Tensor, bool], torch.Tensor], torch.Tensor, Horizon]:
    """What a prediction drives: the problem, pictures with or without the attack, the deployed starts ``[S, n]`` and the horizon."""
    theta = _theta(experiment, scenario, victim, method, seed, folder)
    space = colour_space(experiment)
    surrogate, plain = space.surrogate, space.plain.colours
    problem = attack_problem(experiment, space, load_policy(victim_file(experiment, victim)), scenario, seed)

    def images(states: torch.Tensor, with_attack: bool) -> torch.Tensor:
        return surrogate.sense(states, theta if with_attack else plain).images

    return problem, images, problem.start_states, experiment.limits


def _searched_in(experiment: Experiment, cell: Cell, folder: Path) -> Path | None:
    """Where the attack file of a finished search is: the cell's own folder, or the experiment's where the cell was taken from there."""
    places = [folder]
    if is_current(stages_of(experiment), experiment.folder, "attack"):
        places.append(experiment.stage_folder("attack"))
    return next((at for at in places if attack_path(at, cell).exists()), None)


def _theta(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path
) -> torch.Tensor:
    cell = Cell.of(scenario, victim, method, seed)
    return load_shown(
        colour_space(experiment), _searched_in(experiment, cell, folder) or folder, cell
    ).colours


def _along_the_drive(
    experiment: Experiment, scenario: str, victim: str, seed: int, theta: torch.Tensor | None, of: str
) -> Pictures:
    objects = placed_objects(experiment)
    policy, _ = policy_of(experiment, victim, scenario)
    with experiment.open_world() as scene:
        dressed = DressedScene(scene, experiment.view, objects)
        start = experiment.start_states(scenario, seed)[:1]
        (drive,) = deployed_drives(experiment, dressed, policy, scenario, start, dressed.plain_theta())
        states = drive.states[:-1]
        real = dressed.policy_images(
            dressed.prepare(states), dressed.plain_theta() if theta is None else theta
        )
    surrogate = surrogate_of(experiment, objects)
    shown = surrogate.plain_theta() if theta is None else theta
    learned = [
        as_uint8(image)
        for state in states
        for image in surrogate.sense(torch.from_numpy(state)[None], shown).images
    ]
    return Pictures(of, real, np.stack(learned))
