"""Attack through a renderer of your own: anything with ``theta_shape``, ``initial_theta`` and ``sense`` is a `Sensor`.

    .venv/bin/python examples/attack_through_your_renderer.py

This one draws a rug on the floor with torch. The gradient of a whole drive is compared with finite differences at held camera poses.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd import grad
from torch.nn.functional import grid_sample

import advnerf_core as adv

CAMERA = adv.Pinhole(width=48, height=32, fx=30.0, fy=30.0, cx=24.0, cy=8.0)
HEIGHT_M, RUG_MIDDLE_X_M, RUG_HALF_LENGTH_M, RUG_HALF_WIDTH_M = 0.5, 3.0, 2.0, 1.5


class RugRenderer:
    """A level camera on the car sees a rug; theta holds the rug's colours before the squash."""

    theta_shape = (6, 6, 3)

    def initial_theta(self, generator: torch.Generator) -> Tensor:
        """Grey with a little noise, ``theta_shape``."""
        return 1e-3 * torch.randn(self.theta_shape, generator=generator, dtype=torch.float64)

    def sense(self, states: Tensor, theta: Tensor) -> adv.Rendered:
        """Images ``[B, 3, H, W]`` from states ``[B, 3]``, and their vjp."""
        right, down, _ = torch.tensor(CAMERA.directions()).unbind(-1)
        ahead_m = HEIGHT_M / down.clamp(min=1e-6)  # where the ray of a pixel meets the floor
        left_m = -ahead_m * right
        x, y, yaw = states[:, :3, None, None].unbind(1)
        along = x + ahead_m * torch.cos(yaw) - left_m * torch.sin(yaw) - RUG_MIDDLE_X_M
        across = y + ahead_m * torch.sin(yaw) + left_m * torch.cos(yaw)
        spots = torch.stack([along / RUG_HALF_LENGTH_M, across / RUG_HALF_WIDTH_M], -1)
        theta = theta.detach().requires_grad_()
        with torch.enable_grad():
            rug = torch.sigmoid(theta).permute(2, 0, 1).expand(len(states), -1, -1, -1)
            seen = grid_sample(rug, spots, align_corners=False) * (down > 0.0)
        return adv.Rendered(seen.detach(), lambda slope: grad(seen, theta, slope)[0], seen.nbytes)


class SteersToTheLight:
    """The brighter half of the image wins."""

    stateless = True

    def __call__(self, images: Tensor, goals: Tensor | None = None) -> Tensor:
        """Wheel angles ``[B]`` [rad], left positive, of images ``[B, 3, H, W]`` in 0..1."""
        left, right = images.mean(1).chunk(2, dim=2)
        return 0.3 * torch.tanh(4.0 * (left.mean((1, 2)) - right.mean((1, 2))))


def held_loss(problem: adv.AttackProblem, theta: Tensor, held: Tensor) -> float:
    """Loss [m] of a drive with ``theta`` (``theta_shape``) whose images are taken at the states ``held [T + 1, B, 3]``."""
    states = [problem.start_states]
    for seen_from in held[:-1]:
        images = problem.sensor.sense(seen_from, theta).images
        states.append(problem.dynamics.step(states[-1], problem.policy(images)))
    return float(problem.losses(torch.stack(states)).mean())


if __name__ == "__main__":
    road = adv.Path.from_segments((0.0, 0.0, 0.0), [adv.Line(10.0)], closed=False)
    car = adv.Ackermann(wheelbase_m=0.25, speed_mps=0.8, dt_s=0.1)
    start = torch.tensor([[0.0, 0.1, 0.02]], dtype=torch.float64)
    problem = adv.AttackProblem(SteersToTheLight(), RugRenderer(), car, road, start, steps=30)
    seeded = torch.Generator().manual_seed(0)
    theta, direction = torch.randn(2, 6, 6, 3, generator=seeded, dtype=torch.float64)
    result = adv.adjoint_gradient(problem, theta)
    ahead, behind = (held_loss(problem, theta + h * direction, result.rollout.states) for h in (1e-5, -1e-5))
    adjoint, differences = (result.gradient * direction).sum(), (ahead - behind) / 2e-5
    print(f"slope: adjoint {adjoint:.8f}, finite differences {differences:.8f}")
    attack = adv.gradient_attack(problem, iterations=15, learning_rate=0.5)
    totals_m = [each.predicted_total_cte_m for each in (attack.history[0], attack.best)]
    print("total cross-track error: grey rug {:.2f} m, attacked rug {:.2f} m".format(*totals_m))
