"""The method ``random``, the baseline: the best of as many random textures as the gradient attack may evaluate."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.methods import FRESH_RUN, SearchRun, SearchSettings
from advnerf_core.attack.search.record import Evaluation, SearchResult
from advnerf_core.attack.search.search import (
    begin_drawing,
    go_on,
    random_spread,
    search_fingerprint,
    without_gradient,
)


def search(problem: AttackProblem, settings: SearchSettings, run: SearchRun) -> SearchResult:
    """The method; see `advnerf_core.attack.methods`."""
    return random_search(problem, settings.evaluations, random_spread(problem, settings), run)


def random_search(
    problem: AttackProblem,
    evaluations: int = 50,
    sigma: float = 5.0,
    run: SearchRun = FRESH_RUN,
) -> SearchResult:
    """Draw grid values from ``N(0, sigma^2)`` and keep the best by the objective's value.

    Args:
        evaluations: Total textures, including a resumed state's.
        sigma: Spread of theta; 5 matches the results of gradient attacks.
        run: Seed of the textures, state file and callback.
    """
    shape = problem.sensor.theta_shape

    def draw(generator: torch.Generator) -> Tensor:
        return sigma * torch.randn(shape, generator=generator)

    return best_drawn(problem, draw, evaluations, run, method="random", sigma=sigma)


def best_drawn(
    problem: AttackProblem,
    draw: Callable[[torch.Generator], Tensor],
    evaluations: int,
    run: SearchRun,
    **settings: Any,
) -> SearchResult:
    """Evaluate thetas that are drawn one after the other, and keep the best.

    Args:
        draw: Draws one theta, with all randomness from the generator.
        evaluations: Total thetas, including a resumed state's.
        settings: Settings that a state file must match: the method's name, and everything that ``draw`` depends on.
    """
    fingerprint = search_fingerprint(
        problem, problem.sensor.theta_shape, seed=run.seed, hash=run.settings_hash, **settings
    )
    state, generator = begin_drawing(run, fingerprint, lambda generator: {})

    def step() -> Evaluation:
        theta, began = draw(generator), time.perf_counter()
        state.tensors["generator"] = generator.get_state()
        loss_m, totals = without_gradient(problem, theta, len(state.history))
        return state.record(theta, loss_m, totals, time.perf_counter() - began)

    return go_on(state, run, fingerprint, evaluations, step)
