"""The adjoint gradient against back-propagation and finite differences that freeze the same camera poses."""

import dataclasses

import pytest
import torch
from torch import Tensor, nn

from advnerf_core.attack.adjoint import AttackProblem, RenderCache, adjoint_gradient, evaluate, roll_out
from advnerf_core.driving.actuated import ActuatedAckermann
from advnerf_core.driving.dynamics import Dubins
from advnerf_core.geometry import Pinhole
from advnerf_core.policies.adapter import AdaptedPolicy, adapt
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.frames import FrameStack
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.view import PolicyView
from advnerf_core.scene.surrogate import Rendered
from benchmarks.adjoint_gradient import backpropagated_gradient, finite_difference, relative_error
from tests.support.attack_toy import painted_room, random_policy, toy_problem


def theta_for(problem: AttackProblem, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(problem.sensor.theta_shape, dtype=torch.float64, generator=generator)


@pytest.fixture(scope="module")
def problem() -> AttackProblem:
    return toy_problem(8)


@pytest.fixture(scope="module")
def result(problem):
    return adjoint_gradient(problem, theta_for(problem))


def test_gradient_equals_back_propagation_with_frozen_poses(problem, result):
    loss, gradient = backpropagated_gradient(problem, theta_for(problem), result.rollout)
    assert relative_error(result.gradient, gradient) <= 1e-8
    assert abs(loss - result.loss) <= 1e-12
    assert result.gradient.abs().max() > 1e-4


def test_gradient_equals_finite_differences_with_frozen_poses(problem, result):
    generator = torch.Generator().manual_seed(1)
    for _ in range(2):
        direction = torch.randn(result.gradient.shape, dtype=torch.float64, generator=generator)
        numeric = finite_difference(problem, theta_for(problem), result.rollout, direction)
        assert abs((result.gradient * direction).sum() - numeric) <= 1e-5 * abs(numeric)


@pytest.mark.parametrize(
    "dynamics", [Dubins(0.8, 0.1), ActuatedAckermann(0.25, 0.8, 0.1, lag_s=0.08)], ids=["dubins", "servo lag"]
)
def test_other_dynamics_and_augmented_states(problem, dynamics):
    starts = torch.nn.functional.pad(problem.start_states, (0, dynamics.state_size - 3))
    other = dataclasses.replace(problem, dynamics=dynamics, start_states=starts, steps=5)
    result = adjoint_gradient(other, theta_for(other))
    _, gradient = backpropagated_gradient(other, theta_for(other), result.rollout)
    assert relative_error(result.gradient, gradient) <= 1e-8


def test_batches_and_cache_do_not_change_the_gradient(problem, result):
    for time_batch, cache_bytes in ((1, 0), (3, 0), (3, 3_000_000), (100, 2**40)):
        again = adjoint_gradient(
            dataclasses.replace(problem, time_batch=time_batch, cache_bytes=cache_bytes), theta_for(problem)
        )
        assert relative_error(again.gradient, result.gradient) <= 1e-12
        assert again.loss == result.loss
        assert (again.rerendered == 8) == (cache_bytes == 0)
        assert (again.rerendered == 0) == (cache_bytes > 2**30)


def test_a_cached_rollout_renders_each_frame_once(problem):
    frames = []

    def counting(poses, pinhole):
        frames.append(len(poses))
        return painted_room(poses, pinhole)

    sensor = type(problem.sensor)(
        counting,
        problem.sensor.camera,
        problem.sensor.T_car_from_camera,
        problem.sensor.objects,
        dtype=torch.float64,
    )
    adjoint_gradient(dataclasses.replace(problem, sensor=sensor), theta_for(problem))
    assert sum(frames) == 8 * 2
    frames.clear()
    adjoint_gradient(dataclasses.replace(problem, sensor=sensor, cache_bytes=0), theta_for(problem))
    assert sum(frames) == 2 * 8 * 2


def test_lambda_at_the_start_is_the_derivative_with_respect_to_the_start(problem, result):
    """With images frozen the controls are constants, so lambda_0 is the sensitivity of an open-loop drive."""
    starts = problem.start_states.clone().requires_grad_()
    states = [starts]
    for controls in result.rollout.controls:
        states.append(problem.dynamics.step(states[-1], controls))
    (expected,) = torch.autograd.grad(problem.losses(torch.stack(states)).mean(), starts)
    torch.testing.assert_close(result.lambdas[0], expected, rtol=1e-10, atol=1e-12)


def test_totals_per_start_match_the_loss_and_the_fence_stops_the_reported_total(problem, result):
    torch.testing.assert_close(
        -result.totals.total_cte_m.mean(), torch.tensor(result.loss, dtype=torch.float64)
    )
    torch.testing.assert_close(result.totals.protocol_cte_m, result.totals.total_cte_m)
    fenced = dataclasses.replace(problem, fence_m=float(result.rollout.states[3, :, 1].abs().max()) - 1e-9)
    _, totals = evaluate(fenced, theta_for(problem))
    assert (totals.protocol_cte_m != totals.total_cte_m).any()
    torch.testing.assert_close(totals.total_cte_m, result.totals.total_cte_m)


class Recurrent(nn.Module):
    """A leaky integrator over PilotNet's steering and the mean colour: past images matter through the memory only."""

    stateless = False

    def __init__(self) -> None:
        super().__init__()
        self.network = random_policy()

    def initial_memory(self, batch: int) -> Tensor:
        return torch.zeros(batch, 2, dtype=torch.float64)

    def forward(self, images: Tensor, goals: Tensor | None, memory: Tensor) -> tuple[Tensor, Tensor]:
        now = torch.stack([self.network(images, goals), images.mean((1, 2, 3)) - 0.5], dim=1)
        memory = 0.6 * memory + 0.4 * torch.tanh(3.0 * now) * (1.0 + memory.flip(1))
        return 0.5 * memory[:, 0] + 0.1 * memory[:, 1], memory


def stacked() -> AdaptedPolicy:
    """PilotNet for a mean of three images that are two ticks apart; the first one is repeated."""
    view = PolicyView(Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0))
    contract = PolicyContract(view, frames=FrameStack(count=3, spacing=2, axis="time"))
    network, weights = random_policy(), torch.tensor([0.5, -0.7, 1.2], dtype=torch.float64)
    return adapt(lambda images: network(torch.einsum("btchw,t->bchw", images, weights)), contract)


@pytest.mark.parametrize("policy", [Recurrent().eval(), stacked()], ids=["recurrent", "stack"])
def test_a_policy_with_memory_falls_back_to_the_sequential_adjoint(problem, policy):
    recurrent = dataclasses.replace(problem, policy=policy, steps=6)
    theta = theta_for(problem)
    result = adjoint_gradient(recurrent, theta)
    _, gradient = backpropagated_gradient(recurrent, theta, result.rollout)
    assert relative_error(result.gradient, gradient) <= 1e-8
    direction = torch.randn(theta.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    numeric = finite_difference(recurrent, theta, result.rollout, direction)
    assert abs((result.gradient * direction).sum() - numeric) <= 1e-5 * abs(numeric)
    uncached = adjoint_gradient(dataclasses.replace(recurrent, cache_bytes=0), theta)
    assert relative_error(uncached.gradient, gradient) <= 1e-8


def test_goals_are_repeated_over_the_batch(problem):
    torch.manual_seed(0)
    policy = PilotNet(goal_size=2).double().eval()
    goals = torch.eye(2, dtype=torch.float64)
    goal_problem = dataclasses.replace(problem, policy=policy, goals=goals, steps=3, time_batch=2)
    result = adjoint_gradient(goal_problem, theta_for(problem))
    _, gradient = backpropagated_gradient(goal_problem, theta_for(problem), result.rollout)
    assert relative_error(result.gradient, gradient) <= 1e-8


def test_cache_keeps_to_its_budget():
    cache = RenderCache(100)
    for step in range(4):
        cache.offer(step, Rendered(torch.zeros(1), lambda g: g, 40))
    assert cache.used_bytes == 80
    assert cache.take(0) is not None
    assert cache.take(0) is None
    assert cache.take(3) is None
    assert cache.used_bytes == 40


def test_a_policy_in_training_mode_and_wrong_shapes_are_refused(problem):
    with pytest.raises(ValueError, match="in eval mode"):
        dataclasses.replace(problem, policy=random_policy().train())
    with pytest.raises(ValueError, match=r"expected start states \[B, 3\]"):
        dataclasses.replace(problem, start_states=torch.zeros(3))
    with pytest.raises(ValueError, match="expected steps >= 1"):
        dataclasses.replace(problem, steps=0)


def test_evaluation_and_rollout_agree(problem, result):
    rollout, memories = roll_out(problem, theta_for(problem))
    assert torch.equal(rollout.states, result.rollout.states)
    assert memories == []
