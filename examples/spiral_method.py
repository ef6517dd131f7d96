"""A method of attack of your own: it walks along a spiral of textures.

    .venv/bin/python examples/spiral_method.py
    .venv/bin/advnerf attack run launch/corner.experiment.yaml -o runs/spiral --set 'over.method=[../examples/spiral_method.py:Spiral]'

The method is a function and a `Method` that says what the function needs; see docs/methods.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

import advnerf_core as adv
from advnerf_core.attack.methods import Method, SearchRun, SearchSettings, load_method
from advnerf_core.attack.search.search import begin, evaluate_theta, search_fingerprint

CAMERA, EVALUATIONS = adv.Pinhole(width=48, height=24, fx=30.0, fy=30.0, cx=24.0, cy=12.0), 10


@dataclass(frozen=True)
class Options:
    """What only this method knows: turns, and growth of theta, per evaluation."""

    turns: float = 0.1
    growth: float = 0.4


def search(problem: Any, settings: SearchSettings, run: SearchRun) -> adv.SearchResult:
    """Evaluate textures along a spiral in a random plane; a stopped search goes on from its state file."""
    options, shape = settings.options, problem.sensor.theta_shape
    across, up = torch.randn((2, *shape), generator=torch.Generator().manual_seed(run.seed))
    fingerprint = search_fingerprint(
        problem, shape, method="spiral", seed=run.seed, options=repr(options), hash=run.settings_hash
    )
    state = begin(run.state_path, fingerprint, dict)
    while (number := len(state.history)) < settings.evaluations:
        angle = torch.tensor(2.0 * torch.pi * options.turns * number)
        theta = options.growth * number * (torch.cos(angle) * across + torch.sin(angle) * up)
        evaluate_theta(problem, theta, state, run, fingerprint)
    return state.result()


Spiral = Method(search, Options=Options)


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
    T_world_from_board = adv.make_transform(np.diag([-1.0, -1.0, 1.0]), [3.0, 0.5, 0.2])
    board = adv.cube_face_object(0.8, 8, T_world_from_object=T_world_from_board)
    problem = adv.AttackProblem(
        adv.adapt(steer, adv.PolicyContract(view)),
        adv.Surrogate(grey_room, view.pinhole, adv.camera_mount(0.0, 0.0, 0.2, 0.0), board),
        adv.Ackermann(wheelbase_m=0.25, speed_mps=0.8, dt_s=0.1),
        adv.Path.from_segments((0.0, 0.0, 0.0), [adv.Line(10.0)], closed=False),
        torch.zeros(1, 3, dtype=torch.float64),
        steps=20,
    )
    print(f"total cross-track error after {EVALUATIONS} evaluations of each method:")
    for reference in (f"{__file__}:Spiral", "random", "gradient"):
        method = load_method(reference)
        found = method.search(problem, SearchSettings(EVALUATIONS, options=method.options({})), SearchRun())
        print(f"  {reference.rpartition(':')[2]:9} {found.best.predicted_total_cte_m:.3f} m")
