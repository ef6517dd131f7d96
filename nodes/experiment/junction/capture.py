"""Stage capture: photograph the world, and keep what it says about itself and views of the driving camera that nothing learns from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.posed_images import write_posed_images
from advnerf_core.geometry import Array, planar_pose
from advnerf_core.learning.imitation import recovery_states
from nodes.experiment.junction.context import Experiment
from nodes.experiment.learned_scene import HELD_OUT
from nodes.runtime.progress import Report, counted

PHOTOS = "photos"
# Held-out views lie as far from a path as a fooled car drives [m, of half a lane of 1.75 m], and as turned [rad].
_LATERAL_M, _HEADING_RAD = 1.0, 0.2


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write ``world.json`` and two posed image sets: ``photos`` (learned from) and ``held_out`` (driving camera, without objects)."""
    config = experiment.config.capture
    rng = np.random.default_rng(config.seed)
    with experiment.open_world() as scene:
        experiment.keep_world(scene)
        poses = scene.photo_poses(config.photos, rng)
        states = held_out_states(experiment, rng)
        total = len(poses) + len(states)

        def observed(index: int) -> NDArray[np.uint8]:
            x, y, yaw = map(float, states[index])
            return scene.observe_at(x, y, yaw, depth=False)[0]

        write_posed_images(
            folder / PHOTOS,
            poses,
            scene.photo_pinhole,
            lambda index: scene.photograph(poses[index]),
            "jpg",
            keep=True,
            told=counted(report, PHOTOS, len(poses), 0, total),
        )
        write_posed_images(
            folder / HELD_OUT,
            [planar_pose(*state) @ experiment.mount for state in states],
            experiment.camera,
            observed,
            "png",
            keep=True,
            told=counted(report, HELD_OUT, len(states), len(poses), total),
        )


def held_out_states(experiment: Experiment, rng: np.random.Generator) -> Array:
    """Car states ``[held_out, 3]`` about the stretch of all paths that is measured."""
    names, count = list(experiment.paths), experiment.config.capture.held_out
    driven_m = experiment.config.horizon * experiment.config.dt_s * experiment.car.speed_mps
    parts = []
    for index, name in enumerate(names):
        share = len(range(index, count, len(names)))
        lateral_m = experiment.across_m(_LATERAL_M)
        parts.append(recovery_states(experiment.paths[name], share, rng, lateral_m, _HEADING_RAD, driven_m))
    return np.concatenate(parts)
