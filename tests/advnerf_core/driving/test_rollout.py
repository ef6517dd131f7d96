"""A drive that is not finite ends at once, and the error says whose number was the first."""

import math

import pytest
import torch

from advnerf_core.attack.adjoint import evaluate
from advnerf_core.driving.dynamics import Dubins
from advnerf_core.driving.rollout import drive
from advnerf_core.errors import NotFiniteError
from tests.support.attack_toy import toy_problem

STARTS = torch.zeros(2, 3, dtype=torch.float64)


class Policy:
    """Steers by the mean of the picture; from tick ``fails_at`` on it gives what it was told."""

    stateless, differentiable, goal_size = True, True, 0

    def __init__(self, fails_at=math.inf, answer=math.nan):
        self.fails_at, self.answer, self.asked = fails_at, answer, 0

    def __call__(self, images, goals=None):
        self.asked += 1
        steering = images.mean((1, 2, 3))
        if self.asked > self.fails_at:
            steering[-1] = self.answer  # of one drive among several
        return steering


class Car(Dubins):
    """A car whose state is lost when it has driven for half a metre."""

    def step(self, states, controls):
        moved = super().step(states, controls)
        return torch.where(moved[:, :1] > 0.5, torch.nan, moved)


def pictures(spoiled_beyond_m=math.inf):
    def observe(states):
        images = torch.full((len(states), 3, 2, 2), 0.1, dtype=states.dtype)
        images[states[:, 0] > spoiled_beyond_m, 1] = torch.inf
        return images

    return observe


@pytest.mark.parametrize("answer", [math.nan, math.inf])
def test_a_policy_that_answers_without_a_number_is_named(answer):
    policy = Policy(3, answer)
    with pytest.raises(
        NotFiniteError,
        match=rf"finite steering from the policy, got {answer} at tick 3 for a picture without NaN",
    ):
        drive(policy, pictures(), Dubins(1.0, 0.1), STARTS, 8)
    assert policy.asked == 4


def test_a_picture_without_numbers_is_blamed_on_the_scene_not_on_the_policy():
    with pytest.raises(
        NotFiniteError, match=r"pictures without NaN for the policy, got inf in that of tick 4"
    ):
        drive(Policy(), pictures(spoiled_beyond_m=0.35), Dubins(1.0, 0.1), STARTS, 8)


def test_a_car_that_loses_its_state_is_named():
    with pytest.raises(NotFiniteError, match=r"state of the car after tick 5, got nan for finite steering"):
        drive(Policy(), pictures(), Car(1.0, 0.1), STARTS, 8)


def test_parameters_without_numbers_are_blamed_on_the_method_before_anything_is_drawn():
    problem = toy_problem(2)
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(0))
    theta.reshape(-1)[2] = torch.nan
    with pytest.raises(
        NotFiniteError, match=rf"NaN or infinity in 1 of {theta.numel()}; check the steps of the method"
    ):
        evaluate(problem, theta)
