"""The attack on an experiment's own scene and policy, with other objects, for measuring."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.driving.dynamics import Ackermann
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.policies.policy_file import load_policy
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.surrogate import Surrogate
from calibration.schema import CameraCalibration, RoomCalibration, VehicleCalibration, load_calibration

SPEED_MPS, PERIOD_S = 0.8, 0.1


def lab_problem(folder: Path, objects: Sequence[ColouredObject], steps: int, **options: Any) -> AttackProblem:
    """One start pose, the nominal one; ``options`` go to the problem.

    Args:
        folder: Run folder of an experiment whose stages capture, scene and policy are there.
        objects: What stands in the scene.
        steps: Horizon [ticks].
        options: Other fields of the problem.
    """
    calibration = folder / "capture" / "calibration"
    camera = load_calibration(CameraCalibration, calibration / "camera.yaml")
    vehicle = load_calibration(VehicleCalibration, calibration / "vehicle.yaml")
    room = load_calibration(RoomCalibration, calibration / "room.yaml")
    loaded = load_policy(folder / "policy" / "policy.safetensors")
    renderer = FieldRenderer.from_file(folder / "scene" / "scene.safetensors")
    surrogate = Surrogate(renderer, loaded.view.pinhole, camera.mount, objects)
    limits = (vehicle.limits.steering_min_rad, vehicle.limits.steering_max_rad)
    dynamics = Ackermann(vehicle.wheelbase_m, SPEED_MPS, PERIOD_S, limits)
    starts = torch.tensor([room.start_pose], dtype=torch.float64)
    return AttackProblem(loaded.policy, surrogate, dynamics, room.reference_path, starts, steps, **options)
