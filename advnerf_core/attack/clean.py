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
    return clean_drive_and_value(problem, plain_theta)[0]


def clean_drive_and_value(problem: AttackProblem, plain_theta: Tensor) -> tuple[CleanDrive, float]:
    """As `clean_drive`, and the objective's value of the same drives, mean over the starts, in the objective's unit."""
    rollout, totals = evaluate(problem.undisturbed(), plain_theta)
    drives = problem.judged(rollout.states)
    return CleanDrive.of(drives.metrics, drives.horizon), float(totals.values.mean())
