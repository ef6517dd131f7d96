"""The method ``gradient``: Adam on the grid values, with the gradient from the discrete adjoint over several start poses.

``gradient_coarse`` is the same in the coarse textures that ``cem`` and ``evolution`` search. It separates the value of the gradient from the
value of the finer texture: same parameters, same evaluations, other steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem, Totals, adjoint_gradient
from advnerf_core.attack.methods import FRESH_RUN, GRADIENT_RATE, SearchRun, SearchSettings
from advnerf_core.attack.search.descent import Descent
from advnerf_core.attack.search.population import Coarse
from advnerf_core.attack.search.record import Evaluation, SearchResult
from advnerf_core.attack.search.search import (
    begin,
    go_on,
    gradient_step,
    require_finite,
    require_slope,
    search_fingerprint,
)
from advnerf_core.errors import AdvnerfError


class NoFinerFaceError(AdvnerfError, ValueError):
    """The object is not finer than the coarse texture."""


def search(problem: AttackProblem, settings: SearchSettings, run: SearchRun) -> SearchResult:
    """The method; see `advnerf_core.attack.methods`."""
    return gradient_attack(problem, settings.evaluations, gradient_step(problem, settings), run)


def search_coarse(problem: AttackProblem, settings: SearchSettings, run: SearchRun) -> SearchResult:
    """The method ``gradient_coarse``.

    Raises:
        NoFinerFaceError: The object is not a single face, or has no more cells than the coarse texture.
    """
    problem.coloured("gradient_coarse")
    shape, cells = tuple(problem.sensor.theta_shape), settings.cells
    if Coarse(shape, cells).shape == shape:
        raise NoFinerFaceError(
            f"expected one face of more than {cells} x {cells} cells for the method gradient_coarse, got colours of shape {shape}; "
            "use the method gradient"
        )
    rate = gradient_step(problem, settings)
    return climb(problem, adjoint_slope, settings.evaluations, rate, run, cells, method="gradient_coarse")


def gradient_attack(
    problem: AttackProblem,
    iterations: int = 50,
    learning_rate: float = GRADIENT_RATE,
    run: SearchRun = FRESH_RUN,
) -> SearchResult:
    """Maximise the objective by gradient descent on its loss.

    Each iteration is one evaluation: a closed-loop rollout and its gradient. Iteration 0 evaluates the start.

    Args:
        iterations: Total evaluations, including a resumed state's.
        run: Seed of the starting noise, state file and callback.
    """
    return climb(problem, adjoint_slope, iterations, learning_rate, run, method="gradient")


@dataclass(frozen=True, eq=False)
class Slope:
    """One evaluation of a search along a gradient.

    Attributes:
        loss_m: Loss of the closed-loop drive [m].
        gradient: Gradient that theta descends, ``theta_shape``.
    """

    loss_m: float
    totals: Totals
    gradient: Tensor


SlopeOf = Callable[[AttackProblem, Tensor], Slope]
"""Evaluates a theta in a problem whose disturbances are drawn."""


def adjoint_slope(problem: AttackProblem, theta: Tensor) -> Slope:
    """The loss with its adjoint gradient."""
    result = adjoint_gradient(problem, theta)
    return Slope(result.loss, result.totals, result.gradient)


def climb(
    problem: AttackProblem,
    slope_of: SlopeOf,
    evaluations: int,
    learning_rate: float,
    run: SearchRun,
    cells: int = 0,
    **settings: Any,
) -> SearchResult:
    """Follow a gradient with Adam from the sensor's start, and keep the best theta by the objective's value.

    Args:
        slope_of: Computes drive and gradient.
        evaluations: Total evaluations, including a resumed state's.
        run: Seed of the starting noise, state file and callback.
        cells: Size of the coarse texture that is searched instead of theta, see `Coarse`; 0 searches theta.
        settings: Further settings that a state file must match, including the method's name.

    Raises:
        NotFiniteError: A loss or gradient is not finite.
        ZeroGradientError: The first gradient is zero.
    """
    if cells:
        settings["cells"] = cells
    coarse = Coarse(tuple(problem.sensor.theta_shape), cells)
    fingerprint = search_fingerprint(
        problem,
        coarse.theta_shape,
        seed=run.seed,
        learning_rate=learning_rate,
        hash=run.settings_hash,
        **settings,
    )
    start = torch.Generator().manual_seed(run.seed)
    state = begin(
        run.state_path, fingerprint, lambda: {"theta": coarse.sampled(problem.sensor.initial_theta(start))}
    )
    descent = Descent(state.tensors, learning_rate)

    def step() -> Evaluation:
        began, number = time.perf_counter(), len(state.history)
        theta = coarse.expand(descent.theta)
        slope = slope_of(problem.at_draw(number), theta)
        require_finite(slope.loss_m, slope.gradient, number)
        require_slope(theta, slope.gradient, number)
        evaluated = theta.clone()  # before Adam changes it in place
        descent.step(coarse.gathered(slope.gradient))
        evaluation = state.record(evaluated, slope.loss_m, slope.totals, time.perf_counter() - began)
        state.tensors = descent.tensors
        return evaluation

    return go_on(state, run, fingerprint, evaluations, step)
