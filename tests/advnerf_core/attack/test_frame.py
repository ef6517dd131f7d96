"""Gradients in other spaces and of other goals: on frames without dynamics, and in coarse textures."""

import dataclasses

import numpy as np
import pytest
import torch

from advnerf_core.attack.adjoint import BlackBoxError, adjoint_gradient, evaluate
from advnerf_core.attack.methods import METHODS, SearchRun, SearchSettings
from advnerf_core.attack.problem import NoColoursError
from advnerf_core.attack.robustness import Disturbances, Smoothness
from advnerf_core.attack.search.frame import CleanFrames, better_side
from advnerf_core.attack.search.gradient import NoFinerFaceError
from advnerf_core.attack.search.query_count import VictimError
from advnerf_core.driving.rollout import drive
from tests.support.attack_toy import random_policy, toy_problem

STEPS = 5


@pytest.fixture(scope="module")
def problem():
    return toy_problem(STEPS, time_batch=2)


@pytest.fixture(scope="module")
def theta(problem):
    return torch.randn(
        problem.sensor.theta_shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )


def frames_of(problem):
    return CleanFrames(problem, problem.sensor.plain_theta())


def deviation_by_hand(problem, theta):
    """Steering on the states of the drive without an attack, tick by tick, minus that drive's own."""
    sensor, plain = problem.sensor, problem.sensor.plain_theta()
    clean = drive(
        problem.policy, sensor.observe(plain), problem.dynamics, problem.start_states, problem.steps
    )
    steering = torch.stack([problem.policy(sensor.observe(theta)(x)) for x in clean.states[:-1]])
    return float((steering - clean.controls).sum(0).mean())


def test_the_deviation_is_that_of_the_frames_without_attack(problem, theta):
    frames = frames_of(problem)
    assert frames.deviation(problem.sensor.plain_theta())[0] == pytest.approx(0.0, abs=1e-12)
    found = frames.deviation(theta)[0]
    assert found == pytest.approx(deviation_by_hand(problem, theta), rel=1e-9)
    assert abs(found) > 1e-4


def test_its_gradient_agrees_with_finite_differences(problem, theta):
    gradient = frames_of(problem).deviation(theta)[1]
    generator = torch.Generator().manual_seed(1)
    for _ in range(3):
        direction = torch.randn(theta.shape, generator=generator, dtype=torch.float64)
        direction /= direction.norm()
        h = 1e-4
        difference = (
            deviation_by_hand(problem, theta + h * direction)
            - deviation_by_hand(problem, theta - h * direction)
        ) / (2 * h)
        assert float((gradient * direction).sum()) == pytest.approx(difference, rel=1e-4, abs=1e-9)
    # It is not the gradient of the drive, in which the states move.
    dynamic = adjoint_gradient(problem, theta).gradient
    cosine = torch.nn.functional.cosine_similarity(gradient.flatten(), dynamic.flatten(), dim=0)
    assert abs(float(cosine)) < 0.999


def test_frames_that_are_not_kept_give_the_same(problem, theta):
    kept, forgotten = (frames_of(dataclasses.replace(problem, cache_bytes=n)) for n in (2**28, 0))
    torch.testing.assert_close(kept.deviation(theta), forgotten.deviation(theta))
    jittered = dataclasses.replace(problem, disturbances=Disturbances(gain=0.2, jitter_m=0.01))
    frames = frames_of(jittered)
    (first, _), (again, _), (other, _) = (frames.deviation(theta, draw) for draw in (0, 0, 1))
    assert first == again != other


def test_the_search_climbs_the_deviation_and_keeps_the_best_drive(problem):
    frames, theta = frames_of(problem), problem.sensor.initial_theta(torch.Generator().manual_seed(3))
    side = better_side(frames, theta)
    theta = theta.clone().requires_grad_()
    adam, losses, deviations = torch.optim.Adam([theta], lr=0.5), [], []
    for _ in range(6):
        losses.append(-float(evaluate(problem, theta.detach())[1].total_cte_m.mean()))
        deviation, gradient = frames.deviation(theta.detach())
        deviations.append(side * deviation)
        theta.grad = -side * gradient
        adam.step()
    told = []
    run = SearchRun(seed=3, on_evaluation=told.append)
    result = METHODS["frame"].search(problem, SearchSettings(6, learning_rate=0.5), run)
    np.testing.assert_allclose([e.loss_m for e in result.history], losses, rtol=1e-9)
    assert deviations[-1] > deviations[0]
    totals = [e.predicted_total_cte_m for e in told]
    assert result.best.predicted_total_cte_m == max(totals)
    assert float(evaluate(problem, result.theta)[1].protocol_cte_m.mean()) == pytest.approx(max(totals))


def test_the_side_is_the_one_with_more_to_win():
    class Lopsided:
        def __init__(self, sign):
            self.sign = sign

        def deviation(self, theta, draw=0):
            value = float(theta.sum())
            steering = 2.0 * value if self.sign * value > 0 else value
            return steering, torch.ones_like(theta)

    assert better_side(Lopsided(1), torch.zeros(4)) == 1
    assert better_side(Lopsided(-1), torch.zeros(4)) == -1


def test_smoothness_counts_in_the_loss_and_in_the_step(problem):
    smooth = dataclasses.replace(problem, regulariser=Smoothness(problem.sensor.objects, 1e3))
    settings = SearchSettings(4, learning_rate=0.5)
    found, bare = (METHODS["frame"].search(each, settings, SearchRun()) for each in (smooth, problem))
    start = problem.sensor.initial_theta(torch.Generator().manual_seed(0))
    extra = smooth.regulariser(start)[0]
    assert found.history[0].loss_m == pytest.approx(bare.history[0].loss_m + extra)
    assert found.history[-1].protocol_cte_m != bare.history[-1].protocol_cte_m


def test_what_frames_cannot_be_asked_of_is_refused(problem):
    class Remembering:
        stateless, training = False, False

    class Closed:
        stateless, training, differentiable = True, False, False

    class Bare:
        theta_shape = problem.sensor.theta_shape

    search, settings = METHODS["frame"].search, SearchSettings(2)
    with pytest.raises(VictimError, match="expected a stateless policy for the method frame"):
        search(dataclasses.replace(problem, policy=Remembering()), settings, SearchRun())
    with pytest.raises(BlackBoxError, match="differentiable = False"):
        search(dataclasses.replace(problem, policy=Closed()), settings, SearchRun())
    with pytest.raises(NoColoursError, match="got the parameters of a Bare"):
        search(dataclasses.replace(problem, sensor=Bare()), settings, SearchRun())


def test_goals_reach_the_policy(problem):
    class Turning:
        stateless, training = True, False
        network = random_policy()

        def __call__(self, images, goals=None):
            return self.network(images) * goals[:, 0]

    goals = torch.tensor([[1.0], [0.5]], dtype=torch.float64)
    aimed = dataclasses.replace(problem, policy=Turning(), goals=goals)
    assert frames_of(aimed).deviation(aimed.sensor.plain_theta())[0] == pytest.approx(0.0, abs=1e-12)


def test_the_coarse_gradient_is_adam_on_the_cells():
    problem = toy_problem(3, resolution=12)
    units = torch.eye(9, dtype=torch.float64).reshape(9, 1, 3, 3)
    matrix = torch.nn.functional.interpolate(units, (12, 12), mode="bilinear").reshape(9, -1).T
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(5))
    cells = theta[2::4, 2::4].reshape(9, 3).clone().requires_grad_()
    adam, losses = torch.optim.Adam([cells], lr=0.3), []
    for _ in range(4):
        result = adjoint_gradient(problem, (matrix @ cells.detach()).reshape(12, 12, 3))
        losses.append(result.loss)
        cells.grad = matrix.T @ result.gradient.reshape(-1, 3)
        adam.step()
    settings = SearchSettings(4, learning_rate=0.3, cells=3)
    found = METHODS["gradient_coarse"].search(problem, settings, SearchRun(seed=5))
    np.testing.assert_allclose([e.loss_m for e in found.history], losses, rtol=1e-9)
    flat = found.theta.reshape(-1, 3)
    left = flat - matrix @ torch.linalg.lstsq(matrix, flat).solution
    assert left.abs().max() < 1e-9


def test_there_must_be_a_finer_face_than_the_coarse_texture(problem):
    for cells in (0, 4, 8):
        with pytest.raises(NoFinerFaceError, match=rf"more than {cells} x {cells} cells .*\(4, 4, 3\)"):
            METHODS["gradient_coarse"].search(problem, SearchSettings(2, cells=cells), SearchRun())
