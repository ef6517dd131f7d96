"""An objective of your own: the attack pulls the car to the left of its path, not to the nearer side.

    .venv/bin/python examples/left_objective.py
    .venv/bin/advnerf attack run launch/corner.experiment.yaml -o runs/left --set attack.objective=../examples/left_objective.py:LeftOffset

The objective is a class with a method `value`; see docs/methods.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

import advnerf_core as adv
from advnerf_core.attack.objective import JudgedDrives, Objective
from advnerf_core.attack.objectives import load_objective

CAMERA = adv.Pinhole(width=48, height=24, fx=30.0, fy=30.0, cx=24.0, cy=12.0)


class LeftOffset(Objective):
    """How far the car is to the left of its path, summed over the ticks [m]; negative on the right. Torch differentiates it."""

    def value(self, drives: JudgedDrives) -> Tensor:
        """One number for each drive, ``[B]``; the cross-track error is positive on the left."""
        return drives.cte_m.sum(0)


def steer(images: Tensor) -> Tensor:
    """Wheel angles ``[B]`` [rad] towards the brighter half of images ``[B, 3, H, W]``."""
    left, right = images.mean((1, 2)).chunk(2, dim=1)
    return 0.3 * torch.tanh(4.0 * (left.mean(1) - right.mean(1)))


def grey_room(poses: Any, pinhole: adv.Pinhole) -> tuple[Tensor, Tensor]:
    """Colours ``[B, H, W, 3]`` and depth ``[B, H, W]`` [m] around the car."""
    size = (len(poses), pinhole.height, pinhole.width)
    return torch.full((*size, 3), 0.5, dtype=torch.float64), torch.full(size, 8.0, dtype=torch.float64)


if __name__ == "__main__":
    view = adv.PolicyView(CAMERA, crop_top_px=0, crop_height_px=24, width=48, height=24)
    T_world_from_board = adv.make_transform(np.diag([-1.0, -1.0, 1.0]), [3.0, -0.3, 0.2])  # right of the path
    board = adv.cube_face_object(0.8, 8, T_world_from_object=T_world_from_board)
    path = adv.Path.from_segments((0.0, 0.0, 0.0), [adv.Line(10.0)], closed=False)
    for reference in ("cte", f"{__file__}:LeftOffset"):
        problem = adv.AttackProblem(
            adv.adapt(steer, adv.PolicyContract(view)),
            adv.Surrogate(grey_room, view.pinhole, adv.camera_mount(0.0, 0.0, 0.2, 0.0), board),
            adv.Ackermann(wheelbase_m=0.25, speed_mps=0.8, dt_s=0.1),
            path,
            torch.tensor([[0.0, 0.0, -0.05]], dtype=torch.float64),  # turned a little to the right
            steps=20,
            objective=load_objective(reference),
        )
        found = adv.gradient_attack(problem, iterations=15)
        rollout, _ = adv.evaluate(problem, found.theta)
        end_m = float(path.project(rollout.states[-1, :, :2].numpy()).cte_m[0])
        name, total_m = reference.rpartition(":")[2], found.best.predicted_total_cte_m
        print(f"{name:10} value {found.best.value:.3f} m, total CTE {total_m:.3f} m, ends at {end_m:+.3f} m")
