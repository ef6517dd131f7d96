"""How exact is the adjoint gradient? ``python -m benchmarks.adjoint_gradient`` (float64, about a minute on two cores).

Against back-propagation and against central finite differences through the rollout, both with the camera poses frozen at their
nominal values: that is the derivative the adjoint computes. How near it is to the derivative of the true closed loop, in which
the images follow the states, is measured by ``benchmarks.closed_loop_cosine``.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem, adjoint_gradient
from advnerf_core.driving.rollout import Remembering, Rollout
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.scene.surrogate import PoseBatch, Surrogate
from benchmarks.results import record_row
from tests.support.attack_toy import toy_problem

COMMAND = "python -m benchmarks.adjoint_gradient"


def frozen_frames(problem: AttackProblem, rollout: Rollout) -> list[PoseBatch]:
    """What the camera meets at the nominal poses, before any colour is put on the objects, for each step."""
    sensor = problem.sensor
    assert isinstance(sensor, Surrogate)
    return [sensor.prepare(sensor.camera_poses(states)) for states in rollout.states[:-1]]


def backpropagated_gradient(problem: AttackProblem, theta: Tensor, rollout: Rollout) -> tuple[float, Tensor]:
    """Loss and gradient by plain back-propagation through the whole unrolled loop, images as dense autograd expressions."""
    theta = theta.clone().requires_grad_()
    states = [problem.start_states]
    policy = Remembering.afresh(problem.policy, len(states[0]))
    for frames in frozen_frames(problem, rollout):
        images = _differentiable_images(frames, theta)
        states.append(problem.dynamics.step(states[-1], policy(images, problem.goals)))
    loss = problem.losses(torch.stack(states)).mean()
    (gradient,) = torch.autograd.grad(loss, theta)
    return float(loss.detach()), gradient


def _differentiable_images(frames: PoseBatch, theta: Tensor) -> Tensor:
    (seen,), (W,), (pixels,) = frames.seen, frames.weights, frames.pixels
    assert isinstance(seen.field, VoxelGridObject)
    colours = seen.field.colours(theta)[torch.from_numpy(seen.rows)]
    flat = frames.background.reshape(-1, 3)
    flat = flat.index_add(0, pixels, torch.as_tensor(W.csr().toarray(), dtype=theta.dtype) @ colours)
    return flat.reshape(frames.background.shape).permute(0, 3, 1, 2)


def frozen_loss(problem: AttackProblem, theta: Tensor, frames: list[PoseBatch]) -> float:
    """Loss of the rollout for ``theta`` with the images taken at the nominal poses."""
    policy = Remembering.afresh(problem.policy, len(problem.start_states))
    with torch.no_grad():
        states = [problem.start_states]
        for nominal in frames:
            controls = policy(nominal.render(theta).images, problem.goals)
            states.append(problem.dynamics.step(states[-1], controls))
        return float(problem.losses(torch.stack(states)).mean())


def finite_difference(
    problem: AttackProblem, theta: Tensor, rollout: Rollout, direction: Tensor, step: float = 1e-4
) -> float:
    """Central difference of :func:`frozen_loss` along ``direction``."""
    frames = frozen_frames(problem, rollout)
    plus, minus = (frozen_loss(problem, theta + sign * step * direction, frames) for sign in (1, -1))
    return (plus - minus) / (2 * step)


def relative_error(got: Tensor, expected: Tensor) -> float:
    """Norm of the difference over the norm of what is expected."""
    return float((got - expected).norm() / expected.norm())


def main() -> None:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--steps", type=int, default=40, help="horizon of the comparison [ticks]")
    arguments = parser.parse_args()
    problem = toy_problem(arguments.steps)
    theta = torch.randn(
        problem.sensor.theta_shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    result = adjoint_gradient(problem, theta)
    _, reference = backpropagated_gradient(problem, theta, result.rollout)
    back = relative_error(result.gradient, reference)
    worst = 0.0
    for seed in range(3):
        direction = torch.randn(
            theta.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(10 + seed)
        )
        numeric = finite_difference(problem, theta, result.rollout, direction)
        worst = max(worst, abs(float((result.gradient * direction).sum()) - numeric) / abs(numeric))
    note = f"T = {arguments.steps}, 2 starts, PilotNet, float64, camera poses frozen at nominal"
    print(
        f"against back-propagation: {back:.2e} (target 1e-8)\nagainst finite differences: {worst:.2e} (target 1e-5)"
    )
    record_row(
        "adjoint gradient against back-propagation",
        back,
        "relative",
        "<= 1e-8",
        back <= 1e-8,
        COMMAND,
        note,
    )
    record_row(
        "adjoint gradient against finite differences",
        worst,
        "relative",
        "<= 1e-5",
        worst <= 1e-5,
        COMMAND,
        note,
    )


if __name__ == "__main__":
    main()
