"""Searches by populations of candidates, which need no gradient, so a policy may be a black box: `cem`, `evolution`, and similar ones.

A strategy samples candidates around a mean. The searched texture is coarse, as a few dozen evaluations cannot distinguish thousands
of cells. One evaluation is one closed-loop rollout from all start poses, as for the gradient attack and for random
search, so methods compare at equal evaluations.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.methods import FRESH_RUN, SearchRun, SearchSettings
from advnerf_core.attack.search.record import Evaluation, SearchResult
from advnerf_core.attack.search.search import (
    SearchState,
    begin_drawing,
    go_on,
    search_fingerprint,
    without_gradient,
)


@dataclass(frozen=True)
class Coarse:
    """A coarse texture on a face, interpolated bilinearly to theta; objects other than a single face keep all their colours.

    Attributes:
        cells: Cells along an edge; 0, or as many as the face has, searches theta itself.
    """

    theta_shape: tuple[int, ...]
    cells: int = 0

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the searched parameters."""
        face = len(self.theta_shape) == 3 and self.theta_shape[0] == self.theta_shape[1]
        return (
            (self.cells, self.cells, 3) if face and 0 < self.cells < self.theta_shape[0] else self.theta_shape
        )

    def expand(self, coarse: Tensor) -> Tensor:
        """Theta of a coarse texture."""
        if self.shape == self.theta_shape:
            return coarse
        size = (self.theta_shape[0], self.theta_shape[1])
        images = coarse.permute(2, 0, 1)[None]
        return torch.nn.functional.interpolate(images, size, mode="bilinear")[0].permute(1, 2, 0).contiguous()

    def sampled(self, theta: Tensor) -> Tensor:
        """The coarse texture with theta's values in the middle of its cells; uniform colours are preserved."""
        if self.shape == self.theta_shape:
            return theta
        images = theta.permute(2, 0, 1)[None]
        small = torch.nn.functional.interpolate(images, self.shape[:2], mode="nearest-exact")
        return small[0].permute(1, 2, 0).contiguous()

    def gathered(self, gradient: Tensor) -> Tensor:
        """The gradient with respect to the coarse texture, from the gradient with respect to theta."""
        if self.shape == self.theta_shape:
            return gradient
        with torch.enable_grad():
            coarse = gradient.new_zeros(self.shape).requires_grad_()
            (gathered,) = torch.autograd.grad(self.expand(coarse), coarse, gradient)
        return gathered


class Strategy(Protocol):
    """A distribution of candidates that learns from their losses; its whole state is in tensors."""

    @property
    def name(self) -> str:
        """Name of the method."""

    def fresh(self, shape: tuple[int, ...]) -> dict[str, Tensor]:
        """State before the first generation."""

    def ask(self, known: dict[str, Tensor], population: int, generator: torch.Generator) -> Tensor:
        """Candidates ``[population, *shape]``."""

    def tell(self, known: dict[str, Tensor], candidates: Tensor, losses: Tensor) -> dict[str, Tensor]:
        """State after the candidates' losses ``[population]``."""


def population_search(
    problem: AttackProblem,
    strategy: Strategy,
    evaluations: int = 50,
    population: int = 10,
    cells: int = 8,
    run: SearchRun = FRESH_RUN,
) -> SearchResult:
    """Minimise the loss without its gradient, generation by generation; the best by the objective's value is kept.

    Args:
        strategy: Distribution of candidates, such as `cem.CrossEntropy` or `evolution.Evolution`.
        evaluations: Total rollouts, including a resumed state's; a last generation may stay unfinished.
        population: Candidates of a generation.
        run: Seed of the candidates, state file and callback; a search resumes from its state file to the bit.
    """
    if population < 4:
        raise ValueError(f"expected a population >= 4, got {population}")
    coarse = Coarse(tuple(problem.sensor.theta_shape), cells)
    fingerprint = search_fingerprint(
        problem,
        coarse.theta_shape,
        method=repr(strategy),
        seed=run.seed,
        population=population,
        cells=cells,
        hash=run.settings_hash,
    )

    def generation(known: dict[str, Tensor], generator: torch.Generator) -> dict[str, Tensor]:
        candidates = strategy.ask(known, population, generator)
        losses = torch.zeros(population, dtype=torch.float64)
        return {**known, "candidates": candidates, "losses": losses, "generator": generator.get_state()}

    state, generator = begin_drawing(
        run, fingerprint, lambda generator: generation(strategy.fresh(coarse.shape), generator)
    )

    def step() -> Evaluation:
        evaluation = _evaluate_next(problem, state, coarse, population)
        if len(state.history) % population == 0:
            state.tensors = generation(_learned(strategy, state.tensors), generator)
        return evaluation

    return go_on(state, run, fingerprint, evaluations, step)


def search_with(
    strategy: Strategy, problem: AttackProblem, settings: SearchSettings, run: SearchRun
) -> SearchResult:
    """`population_search` with the settings of a method."""
    return population_search(
        problem, strategy, settings.evaluations, settings.population, settings.cells, run
    )


def _evaluate_next(problem: AttackProblem, state: SearchState, coarse: Coarse, population: int) -> Evaluation:
    began, number = time.perf_counter(), len(state.history)
    theta = coarse.expand(state.tensors["candidates"][number % population])
    loss_m, totals = without_gradient(problem, theta, number)
    state.tensors["losses"][number % population] = loss_m
    return state.record(theta, loss_m, totals, time.perf_counter() - began)


def _learned(strategy: Strategy, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    known = {key: value for key, value in tensors.items() if key not in ("candidates", "losses", "generator")}
    return strategy.tell(known, tensors["candidates"], tensors["losses"])
