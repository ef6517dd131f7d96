"""The reason for the whole method: at equal evaluations the gradient finds more than random textures do, coarse ones included."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem, evaluate
from advnerf_core.attack.methods import SearchRun
from advnerf_core.attack.search.gradient import gradient_attack
from tests.support.attack_toy import toy_problem

STEPS, RESOLUTION, EVALUATIONS, SIGMA = 12, 16, 12, 5.0
LEVELS = (
    1,
    2,
    4,
    8,
    16,
)  # cells along an edge; a policy that averages its image is moved by coarse patterns first


@pytest.fixture(scope="module")
def problem() -> AttackProblem:
    return toy_problem(STEPS, RESOLUTION, torch.float32, time_batch=6)


def random_texture(level: int, generator: torch.Generator) -> Tensor:
    """A random texture of so many cells along an edge, ``[RESOLUTION, RESOLUTION, 3]`` before squashing."""
    cells = SIGMA * torch.randn(1, 3, level, level, generator=generator)
    return torch.nn.functional.interpolate(cells, (RESOLUTION, RESOLUTION), mode="nearest")[0].permute(
        1, 2, 0
    )


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_the_gradient_beats_as_many_random_textures_of_every_coarseness(
    problem: AttackProblem, seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    plain_m = float(evaluate(problem, problem.sensor.initial_theta(generator))[1].protocol_cte_m.mean())
    found = (
        gradient_attack(problem, EVALUATIONS, 0.5, run=SearchRun(seed)).best.predicted_total_cte_m - plain_m
    )
    best = max(
        float(evaluate(problem, random_texture(LEVELS[k % len(LEVELS)], generator))[1].protocol_cte_m.mean())
        - plain_m
        for k in range(EVALUATIONS)
    )
    assert found > 1.2 * max(best, 0.0), f"gradient {found:.3f} m, random {best:.3f} m above {plain_m:.3f} m"
