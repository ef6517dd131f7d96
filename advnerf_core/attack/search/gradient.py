"""The method ``gradient``: Adam on the grid values, the gradient from the discrete adjoint, several start poses together."""

from __future__ import annotations

import math
import time
from pathlib import Path

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem, adjoint_gradient
from advnerf_core.attack.methods import SearchRun, SearchSettings
from advnerf_core.attack.search.search import (
    OnEvaluation,
    SearchDivergedError,
    SearchResult,
    SearchState,
    begin,
    gradient_step,
    search_fingerprint,
)


def search(problem: AttackProblem, settings: SearchSettings, run: SearchRun) -> SearchResult:
    """The method as `advnerf_core.attack.methods` has it."""
    return gradient_attack(
        problem,
        settings.evaluations,
        gradient_step(problem, settings),
        run.seed,
        run.state_path,
        run.on_evaluation,
        run.settings_hash,
    )


def gradient_attack(
    problem: AttackProblem,
    iterations: int = 50,
    learning_rate: float = 0.1,
    seed: int = 0,
    state_path: Path | None = None,
    on_evaluation: OnEvaluation | None = None,
    settings_hash: str = "",
) -> SearchResult:
    """Maximise the total cross-track error by gradient descent on its negative.

    Each iteration is one evaluation: a closed-loop rollout and its gradient. Iteration 0 evaluates the start.

    Args:
        problem: What is attacked.
        iterations: Evaluations in all, those of a resumed state included.
        learning_rate: Of Adam.
        seed: Of the starting noise.
        state_path: State file, written after every iteration; if it exists, the attack goes on from it.
        on_evaluation: Called after every iteration.
        settings_hash: Hash of scene, policy and configuration; a state file of another one is refused.
    """
    if iterations < 1:
        raise ValueError(f"expected at least one iteration, got {iterations}")
    shape = problem.sensor.theta_shape
    fingerprint = search_fingerprint(
        problem, shape, method="gradient", seed=seed, learning_rate=learning_rate, hash=settings_hash
    )
    start = torch.Generator().manual_seed(seed)
    state = begin(state_path, fingerprint, lambda: {"theta": problem.sensor.initial_theta(start)})
    theta, adam = _adam(state, learning_rate)
    while len(state.history) < iterations:
        began = time.perf_counter()
        result = adjoint_gradient(problem.at_draw(len(state.history)), theta)
        if not (math.isfinite(result.loss) and bool(torch.isfinite(result.gradient).all())):
            raise SearchDivergedError(
                f"expected a finite loss and gradient at iteration {len(state.history)}, got loss {result.loss}; "
                "check the policy and the scene for NaN"
            )
        evaluated = theta.detach().clone()
        theta.grad = result.gradient
        adam.step()
        evaluation = state.record(evaluated, result.loss, result.totals, time.perf_counter() - began)
        state.tensors = _tensors(theta, adam)
        if state_path is not None:
            state.save(state_path, fingerprint)
        if on_evaluation is not None:
            on_evaluation(evaluation)
    return state.result()


def _adam(state: SearchState, learning_rate: float) -> tuple[Tensor, torch.optim.Adam]:
    theta = state.tensors["theta"].clone().requires_grad_()
    adam = torch.optim.Adam([theta], lr=learning_rate)
    moments = {key: value.clone() for key, value in state.tensors.items() if key != "theta"}
    if moments:
        adam.state[theta] = moments
    return theta, adam


def _tensors(theta: Tensor, adam: torch.optim.Adam) -> dict[str, Tensor]:
    return {
        "theta": theta.detach().clone(),
        **{key: value.clone() for key, value in adam.state[theta].items()},
    }
