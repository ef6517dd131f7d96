"""Attack a policy of your own: a line follower, and a board beside the road that learns to look like the line.

    .venv/bin/python examples/attack_your_policy.py

Put your network in place of `LineFollower`, and say in the `PolicyContract` what goes in and comes out. The scene is a formula here;
a learned one is ``FieldRenderer.from_file("scene.safetensors")``.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import advnerf_core as adv

CAMERA = adv.Pinhole(width=96, height=48, fx=60.0, fy=60.0, cx=48.0, cy=16.0)
LINE_RGB, FLOOR_RGB, SKY_RGB, CARDBOARD_RGB = (
    (0.9, 0.8, 0.1),
    (0.4, 0.4, 0.4),
    (0.6, 0.7, 0.9),
    (0.5, 0.4, 0.3),
)
EVALUATIONS = 12


class LineFollower(nn.Module):
    """Steers to the middle of what is yellow: images ``[B, 3, H, W]`` BGR in 0..255 to degrees ``[B]``, positive to the right."""

    def forward(self, images: Tensor) -> Tensor:
        """Steering ``[B]`` [deg]."""
        blue, green, red = (images / 255.0).unbind(1)
        yellow = torch.relu(torch.minimum(red, green) - blue) ** 2
        columns = torch.linspace(-1.0, 1.0, yellow.shape[2], dtype=yellow.dtype)
        return 25.0 * (yellow * columns).sum((1, 2)) / (yellow.sum((1, 2)) + 0.1)


def road(T_world_from_camera: NDArray[np.float64], pinhole: adv.Pinhole) -> tuple[Tensor, Tensor]:
    """Floor with a yellow line along y = 0: colours ``[B, H, W, 3]`` in 0..1 and planar depth ``[B, H, W]`` [m]."""
    pose = T_world_from_camera[:, None, None]
    rays = (pose[..., :3, :3] @ pinhole.directions()[..., None])[..., 0]
    to_floor_m = pose[..., 2, 3] / np.maximum(-rays[..., 2], 1e-9)
    y_m = pose[..., 1, 3] + to_floor_m * rays[..., 1]
    rgb = np.where((np.abs(y_m) < 0.05)[..., None], LINE_RGB, FLOOR_RGB)
    is_sky = rays[..., 2] >= 0.0
    return torch.tensor(np.where(is_sky[..., None], SKY_RGB, rgb)), torch.tensor(
        np.where(is_sky, np.inf, to_floor_m)
    )


if __name__ == "__main__":
    view = adv.PolicyView(CAMERA, crop_top_px=0, crop_height_px=48, width=96, height=48)
    contract = adv.PolicyContract(
        view, colour_space="BGR", value_max=255.0, output_unit="deg", positive="right"
    )
    # The x axis of the board leaves its face: it looks back along the road, 0.7 m to the left of the line.
    T_world_from_board = adv.make_transform(np.diag([-1.0, -1.0, 1.0]), [4.0, 0.7, 0.3])
    board = adv.cube_face_object(0.6, 4, CARDBOARD_RGB, T_world_from_board)
    sensor = adv.Surrogate(road, view.pinhole, adv.camera_mount(0.2, 0.0, 0.3, pitch_down_rad=0.15), board)
    problem = adv.AttackProblem(
        policy=adv.adapt(LineFollower().eval(), contract),
        sensor=sensor,
        dynamics=adv.Ackermann(wheelbase_m=0.25, speed_mps=0.8, dt_s=0.1),
        path=adv.Path.from_segments((0.0, 0.0, 0.0), [adv.Line(10.0)], closed=False),
        start_states=adv.draw_start_states((0.0, 0.0, 0.0), count=1),
        steps=40,
    )
    plain_m = float(adv.evaluate(problem, sensor.plain_theta())[1].protocol_cte_m.mean())
    chance = adv.random_search(problem, EVALUATIONS)
    attack = adv.gradient_attack(problem, EVALUATIONS, learning_rate=0.5)
    print(f"total cross-track error over {problem.steps} ticks, {EVALUATIONS} evaluations for each search:")
    print(f"  cardboard     {plain_m:.2f} m")
    print(f"  best random   {chance.best.predicted_total_cte_m:.2f} m")
    print(f"  gradient      {attack.best.predicted_total_cte_m:.2f} m")
    red, green, blue = torch.sigmoid(attack.theta).mean((0, 1)).tolist()
    print(f"mean colour of the attacked board: red {red:.2f}, green {green:.2f}, blue {blue:.2f}")
