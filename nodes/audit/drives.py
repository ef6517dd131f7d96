"""Drives of an audit: past nothing, a plain object, a picture, or an attack; in a learned scene, or in a world by its own car."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.artifact import load_attack
from advnerf_core.attack.robustness import Disturbances
from advnerf_core.attack.spaces.space import ColourSpace, Shown
from advnerf_core.driving.metrics import DriveMetrics
from advnerf_core.fields.voxel_grid import inverse_squash
from advnerf_core.geometry import Array
from hardware.worlds.world import World
from nodes.audit.question import VICTIM
from nodes.audit.verdict import ArmDrives
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.drives import deployed_drives, learned_drives
from nodes.experiment.show.learned_scene import HELD_OUT, captured
from nodes.experiment.show.spaces import colour_space, dress, shown_there
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import attack_problem, from_measured_starts

NO_OBJECT, PLAIN_OBJECT, PICTURE, FOUND = "no_object", "plain_object", "natural_picture", "object"
# The same two under `camera_effects`.
PLAIN_DISTURBED, FOUND_DISTURBED = "plain_object_disturbed", "object_disturbed"
# Whether an attack survives another camera: variations like those of cheap cameras and their mounts from day to day.
NOISE, GAIN, BRIGHTNESS, JITTER_RAD = 0.02, 0.1, 0.02, 0.01
_JITTER = 0.04  # relative to the lane's half width


def with_starts(experiment: Experiment, count: int, seed: int) -> Experiment:
    """The same experiment, measured from other starts."""
    measure = experiment.config.measure.model_copy(update={"starts": count, "seed": seed})
    return replace(experiment, config=experiment.config.model_copy(update={"measure": measure}))


@dataclass(frozen=True, eq=False)
class Arm:
    """The objects of a group of drives.

    Attributes:
        shown: The objects.
        attack: The attack file; None for a control.
        disturbances: Effects of a worse camera in the learned scene; None for the ideal one.
    """

    shown: Shown
    attack: Path | None = None
    disturbances: Disturbances | None = None


def arm_of(experiment: Experiment, name: str, found: Path | None = None) -> Arm:
    """One arm of an audit by its name; ``found`` is the attack file, for `FOUND` only."""
    if name == NO_OBJECT:
        return Arm(Shown((), torch.zeros(0, 3)))
    space = colour_space(experiment)
    if name == PLAIN_OBJECT:
        return Arm(space.plain)
    if name == PICTURE:
        return Arm(replace(space.plain, colours=_picture(experiment, space)))
    assert found is not None, "an object was found by a search"
    return Arm(space.restored(load_attack(found)), found)


def red_all_over(experiment: Experiment) -> Shown:
    """The object in the reddest possible colour."""
    plain = colour_space(experiment).plain
    red = torch.from_numpy(inverse_squash([1.0, 0.0, 0.0])).to(plain.colours.dtype)
    return replace(plain, colours=red.expand(plain.colours.shape).clone())


def _picture(experiment: Experiment, space: ColourSpace) -> Tensor:
    """Colours of the object that show a photograph of the place, the middle of the first held-out view."""
    plain = space.plain.colours
    views = captured(experiment, HELD_OUT).load()
    rgb = np.asarray(views.rgb[0])
    side = min(rgb.shape[:2])
    top, left = (rgb.shape[0] - side) // 2, (rgb.shape[1] - side) // 2
    square = rgb[top : top + side, left : left + side]
    if plain.ndim == 3:
        size = plain.shape[1], plain.shape[0]
        small = cv2.resize(square, size, interpolation=cv2.INTER_AREA)
    else:  # the voxels of solid objects have no two directions: they take its colours in order
        index = np.linspace(0, square.shape[0] * square.shape[1] - 1, plain.shape[0]).astype(int)
        small = square.reshape(-1, 3)[index]
    return torch.from_numpy(inverse_squash(small / 255.0)).to(plain.dtype).reshape(plain.shape)


def camera_effects(limit_m: float, seed: int) -> Disturbances:
    """Noise, exposure and a shaking mount, for a lane that ends at a |CTE| of ``limit_m``."""
    return Disturbances(NOISE, GAIN, BRIGHTNESS, _JITTER * limit_m, JITTER_RAD, seed)


def learned(experiment: Experiment, arm: Arm) -> ArmDrives:
    """Drives in the learned scene, as searches render it, from the measured starts."""
    scenario = experiment.config.paths[0]
    policy = load_victim(experiment, VICTIM)
    space = colour_space(experiment)
    problem = attack_problem(experiment, space, policy, scenario, 0)
    there = replace(problem, sensor=arm.shown.seen_by(space.surrogate))
    measured = from_measured_starts(experiment, scenario, there)
    states, _, scores = learned_drives(
        experiment, replace(measured, disturbances=arm.disturbances), arm.shown.colours
    )
    return _drives(experiment, list(states), scores)


def driven(
    experiment: Experiment,
    arm: Arm,
    world: World,
    report: Callable[[int], None] = lambda done: None,
) -> ArmDrives:
    """Drives through an open world, by its own car, from the measured starts; ``report`` gets the number of finished ones."""
    scenario = experiment.config.paths[0]
    policy = load_victim(experiment, VICTIM).policy
    attack = None if arm.attack is None else load_attack(arm.attack)
    there = dress(experiment, world, arm.shown)
    starts = experiment.measured_starts(scenario)
    colours = shown_there(experiment, arm.shown, attack)
    found = deployed_drives(experiment, there, policy, scenario, starts, colours, report)
    return _drives(experiment, [each.states for each in found], [each.metrics for each in found])


def _drives(experiment: Experiment, states: Sequence[Array], scores: Sequence[DriveMetrics]) -> ArmDrives:
    ticks = experiment.config.horizon + 1
    whole = [np.asarray(each)[:, :3] for each in states]
    held = [
        np.concatenate([each, np.repeat(each[-1:], max(0, ticks - len(each)), axis=0)])[:ticks]
        for each in whole
    ]
    return ArmDrives.of(np.stack(held), scores, [len(each.ctes_m) - each.held_ticks for each in scores])


def pictures_along(experiment: Experiment, states: Array, shown: Shown) -> Tensor:
    """Policy images in the learned scene from car states ``[N, 3]``: ``[N, 3, H, W]`` in 0..1."""
    surrogate = shown.seen_by(colour_space(experiment).surrogate)
    poses = surrogate.camera_poses(torch.from_numpy(np.asarray(states, dtype=np.float64)))
    return surrogate.render(poses, shown.colours if shown.objects else None).images
