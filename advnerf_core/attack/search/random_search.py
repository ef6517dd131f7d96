"""The method ``random``, the baseline: random textures, the best of as many as the gradient attack may evaluate."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.methods import SearchRun, SearchSettings
from advnerf_core.attack.search.search import (
    OnEvaluation,
    SearchResult,
    begin,
    evaluate_theta,
    random_spread,
    search_fingerprint,
)


def search(problem: AttackProblem, settings: SearchSettings, run: SearchRun) -> SearchResult:
    """The method as `advnerf_core.attack.methods` has it."""
    return random_search(
        problem,
        settings.evaluations,
        random_spread(problem, settings),
        run.seed,
        run.state_path,
        run.on_evaluation,
        run.settings_hash,
    )


def random_search(
    problem: AttackProblem,
    evaluations: int = 50,
    sigma: float = 5.0,
    seed: int = 0,
    state_path: Path | None = None,
    on_evaluation: OnEvaluation | None = None,
    settings_hash: str = "",
) -> SearchResult:
    """Draw grid values from ``N(0, sigma^2)`` and keep the best by the objective's value.

    Args:
        problem: What is attacked.
        evaluations: Textures in all, those of a resumed state included.
        sigma: Spread of theta; 5 matches what gradient attacks end at.
        seed: Of the textures.
        state_path: State file, written after every evaluation; if it exists, the search goes on from it.
        on_evaluation: Called after every evaluation.
        settings_hash: Hash of scene, policy and configuration; a state file of another one is refused.
    """
    run = SearchRun(seed, state_path, on_evaluation, settings_hash)
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
        problem: What is attacked.
        draw: Draws one; all its randomness is the generator's.
        evaluations: Thetas in all, those of a resumed state included.
        run: Seed, state file and callback.
        settings: What a state file must agree in: the method's name, and all that ``draw`` depends on.
    """
    if evaluations < 1:
        raise ValueError(f"expected at least one evaluation, got {evaluations}")
    fingerprint = search_fingerprint(
        problem, problem.sensor.theta_shape, seed=run.seed, hash=run.settings_hash, **settings
    )
    generator = torch.Generator().manual_seed(run.seed)
    state = begin(run.state_path, fingerprint, lambda: {"generator": generator.get_state()})
    generator.set_state(state.tensors["generator"])
    while len(state.history) < evaluations:
        theta = draw(generator)
        state.tensors["generator"] = generator.get_state()
        evaluate_theta(problem, theta, state, run, fingerprint)
    return state.result()
