"""Tests whether a policy drives, with closed-loop drives around a path in a learned scene or the simulated lab, without an attack."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.clean import clean_drive
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.driving.clean_drive import CleanDrive
from advnerf_core.driving.dynamics import Ackermann
from advnerf_core.scene.surrogate import Rendered
from calibration.schema import RoomCalibration, VehicleCalibration

# Number of drives that together cover the path once. Each starts on the path.
_STARTS = 4
_SPEED_MPS, _PERIOD_S = 0.8, 0.1

See = Callable[[Tensor], Tensor]
"""Policy images ``[B, 3, H, W]`` RGB in 0..1 from car states ``[B, 3]``."""


class _ClearSensor:
    """A sensor without objects, for a drive."""

    theta_shape = (0, 3)

    def __init__(self, see: See) -> None:
        self._see = see

    def initial_theta(self, generator: torch.Generator) -> Tensor:
        return torch.zeros(self.theta_shape)

    def sense(self, states: Tensor, theta: Tensor) -> Rendered:
        images = self._see(states)
        return Rendered(images, lambda grad: torch.zeros(self.theta_shape), images.nbytes)


def drive_round(
    policy: Any, see: See, room: RoomCalibration, vehicle: VehicleCalibration, goal: tuple[float, ...] = ()
) -> CleanDrive:
    """Drive once around the room's path, in parts that each start on it.

    Args:
        policy: A policy in eval mode.
    """
    path, count = room.reference_path, _STARTS
    starts = torch.from_numpy(path.pose_at(np.arange(count) / count * path.length_m))
    limits = (vehicle.limits.steering_min_rad, vehicle.limits.steering_max_rad)
    goals = torch.tensor([goal] * count, dtype=torch.float32) if goal else None
    problem = AttackProblem(
        policy,
        _ClearSensor(see),
        Ackermann(vehicle.wheelbase_m, _SPEED_MPS, _PERIOD_S, limits),
        path,
        starts,
        math.ceil(path.length_m / count / (_SPEED_MPS * _PERIOD_S)),
        goals,
        fence_m=float(np.abs(np.array(room.fence_m)).min()),
        off_track_m=room.off_track_m,
    )
    return clean_drive(problem, torch.zeros(_ClearSensor.theta_shape))
