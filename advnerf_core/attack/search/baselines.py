"""The baseline: random textures, the best of as many as the gradient attack may evaluate."""

from __future__ import annotations

import time
from pathlib import Path

import torch

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.search.search import OnEvaluation, SearchResult, begin, search_fingerprint, without_gradient


def random_search(
    problem: AttackProblem,
    evaluations: int = 50,
    sigma: float = 5.0,
    seed: int = 0,
    state_path: Path | None = None,
    on_evaluation: OnEvaluation | None = None,
    settings_hash: str = "",
) -> SearchResult:
    """Draw grid values from ``N(0, sigma^2)`` and keep the best by predicted total CTE.

    Args:
        problem: What is attacked.
        evaluations: Textures in all, those of a resumed state included.
        sigma: Spread of theta; 5 matches what gradient attacks end at.
        seed: Of the textures.
        state_path: State file, written after every evaluation; if it exists, the search goes on from it.
        on_evaluation: Called after every evaluation.
        settings_hash: Hash of scene, policy and configuration; a state file of another one is refused.
    """
    if evaluations < 1:
        raise ValueError(f"expected at least one evaluation, got {evaluations}")
    shape = problem.sensor.theta_shape
    fingerprint = search_fingerprint(problem, shape, method="random", seed=seed, sigma=sigma, hash=settings_hash)
    generator = torch.Generator().manual_seed(seed)
    state = begin(state_path, fingerprint, lambda: {"generator": generator.get_state()})
    generator.set_state(state.tensors["generator"])
    while len(state.history) < evaluations:
        began = time.perf_counter()
        theta = sigma * torch.randn(shape, generator=generator)
        loss_m, totals = without_gradient(problem, theta, len(state.history))
        evaluation = state.record(theta, loss_m, totals, time.perf_counter() - began)
        state.tensors["generator"] = generator.get_state()
        if state_path is not None:
            state.save(state_path, fingerprint)
        if on_evaluation is not None:
            on_evaluation(evaluation)
    return state.result()
