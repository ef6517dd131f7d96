"""Drives of the victim without an attack: plain object, same starts, same scene."""

from __future__ import annotations

from torch import Tensor

from advnerf_core.attack.adjoint import evaluate
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.driving.clean_drive import CleanDrive


def clean_drive(problem: AttackProblem, plain_theta: Tensor) -> CleanDrive:
    """Drive without disturbances and without an attack.

    Args:
        plain_theta: Parameters of the objects without an attack.
    """
    rollout, _ = evaluate(problem.undisturbed(), plain_theta)
    drives = problem.judged(rollout.states)
    return CleanDrive.of(drives.metrics, drives.horizon)
