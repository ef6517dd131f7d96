"""Drives past objects, in the learned scene and in the deployment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem, evaluate
from advnerf_core.attack.objective import JudgedDrives
from advnerf_core.driving.metrics import DriveMetrics
from advnerf_core.geometry import Array
from advnerf_core.policies.network import Policy
from hardware.cameras.effects import ImperfectCamera
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import DeployedDrive, Dressed, IdealDriving, SelfDriving, drive_deployed
from nodes.experiment.show.victims import told


def learned_drives(
    experiment: Experiment, problem: AttackProblem, theta: Tensor
) -> tuple[Array, Array, Sequence[DriveMetrics]]:
    """States ``[B, T + 1, n]`` and commands ``[B, T]`` of the drives from all starts of a problem in its own scene, and their metrics."""
    rollout, _ = evaluate(problem, theta)
    states, commands = (each.transpose(0, 1).numpy() for each in (rollout.states, rollout.controls))
    judged = JudgedDrives(rollout.states, problem.path, experiment.limits, experiment.world.fence_m)
    return states, commands, judged.metrics


def deployed_drives(
    experiment: Experiment,
    dressed: Dressed,
    policy: Policy,
    scenario: str,
    starts: Tensor,
    theta: Tensor | None,
    report: Callable[[int], None] = lambda done: None,
) -> list[DeployedDrive]:
    """Drives through the deployment scene from starts ``[B, 3]``, with its own car or an ideal one; ``report`` gets the number of finished ones."""
    effects, car, found = experiment.config.deploy.camera, _car(experiment, dressed), []
    for number, start in enumerate(starts.numpy()):
        drive = drive_deployed(
            dressed,
            policy,
            told(experiment, policy, scenario),
            np.asarray(start),
            experiment.paths[scenario],
            experiment.limits,
            car,
            theta,
            None if effects.ideal else ImperfectCamera(effects, experiment.camera, number),
        )
        found.append(drive)
        report(len(found))
    return found


def _car(experiment: Experiment, dressed: Dressed) -> SelfDriving | IdealDriving:
    if experiment.config.deploy.car == "ideal":
        return IdealDriving(experiment.dynamics, experiment.world.fence_m)
    return SelfDriving(dressed.scene, experiment.car.speed_mps, experiment.limits.dt_s)


def totals(scores: Sequence[DriveMetrics]) -> dict[str, Any]:
    """Total CTE [m], whether the track was left, and ticks until the car stopped, drive by drive."""
    return {
        "total_cte_m": [score.total_cte_m for score in scores],
        "off_track": [score.off_track for score in scores],
        "driven_ticks": [len(score.ctes_m) - score.held_ticks for score in scores],
    }
