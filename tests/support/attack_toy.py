"""A small closed loop for measuring the attack: a painted room, a face at the corner, and a frozen PilotNet with random weights.

The background is a smooth function of the viewing ray (no learned scene is needed to test a gradient), but it depends on the
camera pose, so the loop is truly closed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.driving.dynamics import Ackermann
from advnerf_core.driving.path import Path
from advnerf_core.fields.voxel_grid import VoxelGridObject, cube_face_object
from advnerf_core.geometry import Array, Pinhole, camera_mount, make_transform, rotation_z
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.scene.surrogate import Surrogate

VIEW = Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0).cropped(0, 40, 336, 111).resized(200, 66)
MOUNT = camera_mount(0.30, 0.0, 0.20, np.deg2rad(10.0))
T_WORLD_FROM_FACE = make_transform(rotation_z(np.deg2rad(172.0)), [3.14, -1.75, 0.42])


def painted_room(poses: Array, pinhole: Pinhole) -> tuple[Tensor, Tensor]:
    """Smooth colours by ray direction and camera position, ``[B, H, W, 3]``, at a depth beyond the face, ``[B, H, W]``."""
    rays = torch.as_tensor(pinhole.directions() @ np.swapaxes(poses[:, None, :3, :3], -1, -2))
    rays = rays / rays.norm(dim=-1, keepdim=True)
    position = torch.as_tensor(poses[:, None, None, :3, 3])
    phase = 3.0 * rays + 0.8 * position
    return 0.5 + 0.3 * torch.sin(phase), torch.full(rays.shape[:3], 8.0, dtype=torch.float64)


def random_policy(seed: int = 0, dtype: torch.dtype = torch.float64) -> PilotNet:
    """A PilotNet with random weights, scaled so that images steer it noticeably, frozen."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        policy = PilotNet(max_steering_rad=0.25)
    with torch.no_grad():
        for name, weights in policy.named_parameters():
            if name.endswith("weight"):
                weights.mul_(1.7)
    return policy.to(dtype).eval().requires_grad_(False)


def face(resolution: int = 4) -> VoxelGridObject:
    """The attacked face where the lab has its board."""
    return cube_face_object(0.80, resolution, T_world_from_object=T_WORLD_FROM_FACE)


def toy_problem(
    steps: int, resolution: int = 4, dtype: torch.dtype = torch.float64, **options: Any
) -> AttackProblem:
    """Two start poses off the line (away from the kink of |CTE|), facing the object; ``options`` go to the problem."""
    sensor = Surrogate(painted_room, VIEW, MOUNT, face(resolution), dtype=dtype)
    starts = torch.tensor([[-1.1, -1.75, 0.05], [-0.9, -2.3, -0.05]], dtype=torch.float64)
    settings = {"policy": random_policy(dtype=dtype), "start_states": starts, **options}
    dynamics = Ackermann(0.25, 0.8, 0.1)
    return AttackProblem(
        sensor=sensor, dynamics=dynamics, path=Path.rounded_square(4.0, 1.1), steps=steps, **settings
    )
