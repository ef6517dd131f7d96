import pytest
import torch

from advnerf_core.attack.adjoint import adjoint_gradient
from benchmarks.adjoint_memory import gradient_by, measure, unrolled_gradient
from tests.support.attack_toy import toy_problem


def test_both_methods_compute_the_same_gradient():
    problem = toy_problem(3)
    theta = torch.randn(
        problem.sensor.theta_shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    loss, gradient = unrolled_gradient(problem, theta)
    result = adjoint_gradient(problem, theta)
    assert abs(result.loss - loss) < 1e-12
    torch.testing.assert_close(result.gradient, gradient, rtol=1e-9, atol=1e-15)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_horizon():
    short, long = measure([50, 400])
    assert long["adjoint_mib"] <= 1.1 * short["adjoint_mib"]
    assert long["backprop_mib"] > 4 * short["backprop_mib"]


@pytest.mark.parametrize("way", ["cached", "checkpointed"])
def test_the_ways_that_are_compared_agree(way):
    problem = toy_problem(3)
    theta = torch.randn(
        problem.sensor.theta_shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    result = adjoint_gradient(problem, theta)
    torch.testing.assert_close(gradient_by(way, problem, theta)[1], result.gradient, rtol=1e-9, atol=1e-15)
