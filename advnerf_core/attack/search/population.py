"""Searches that need no gradient, so a policy may be a black box: the cross-entropy method and an evolution strategy.

Both sample candidates around a mean, and both search a coarse texture, as a few dozen evaluations cannot tell thousands
of cells apart. One evaluation is one closed-loop rollout from all start poses, as for the gradient attack and for random
search, so methods compare at equal evaluations.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.search.search import (
    Evaluation,
    OnEvaluation,
    SearchResult,
    SearchState,
    begin,
    search_fingerprint,
    without_gradient,
)

_ELITE_SHARE = 0.3
_CEM_SMOOTHING = 0.7
_LEAST_SIGMA = 0.1  # of the first one; a spread of zero finds nothing new
_ADAM = (0.9, 0.999, 1e-8)


@dataclass(frozen=True)
class Coarse:
    """A coarse texture on a face, interpolated bilinearly to theta; objects that are no single face keep all their colours.

    Attributes:
        theta_shape: Shape of theta.
        cells: Cells along an edge; 0, or as many as the face has, searches theta itself.
    """

    theta_shape: tuple[int, ...]
    cells: int = 0

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of what is searched."""
        face = len(self.theta_shape) == 3 and self.theta_shape[0] == self.theta_shape[1]
        return (self.cells, self.cells, 3) if face and 0 < self.cells < self.theta_shape[0] else self.theta_shape

    def expand(self, coarse: Tensor) -> Tensor:
        """Theta of a coarse texture."""
        if self.shape == self.theta_shape:
            return coarse
        size = (self.theta_shape[0], self.theta_shape[1])
        images = coarse.permute(2, 0, 1)[None]
        return torch.nn.functional.interpolate(images, size, mode="bilinear")[0].permute(1, 2, 0).contiguous()


class Strategy(Protocol):
    """How candidates are drawn, and what is learned from them; everything it knows is in tensors."""

    @property
    def name(self) -> str:
        """Name of the method."""

    def fresh(self, shape: tuple[int, ...]) -> dict[str, Tensor]:
        """What is known before the first generation."""

    def ask(self, known: dict[str, Tensor], population: int, generator: torch.Generator) -> Tensor:
        """Candidates ``[population, *shape]``."""

    def tell(self, known: dict[str, Tensor], candidates: Tensor, losses: Tensor) -> dict[str, Tensor]:
        """What is known after their losses ``[population]``."""


@dataclass(frozen=True)
class CrossEntropy:
    """Refit a normal distribution with a diagonal covariance to the best candidates.

    de Boer, Kroese, Mannor and Rubinstein 2005, "A Tutorial on the Cross-Entropy Method", with their smoothing.

    Attributes:
        sigma: First spread of every cell; the first mean is zero, which is grey.
    """

    sigma: float = 3.0
    name: str = "cem"

    def fresh(self, shape: tuple[int, ...]) -> dict[str, Tensor]:
        """Grey, and the first spread."""
        return {"mean": torch.zeros(shape), "spread": torch.full(shape, self.sigma)}

    def ask(self, known: dict[str, Tensor], population: int, generator: torch.Generator) -> Tensor:
        """Draw from the distribution."""
        return known["mean"] + known["spread"] * torch.randn((population, *known["mean"].shape), generator=generator)

    def tell(self, known: dict[str, Tensor], candidates: Tensor, losses: Tensor) -> dict[str, Tensor]:
        """Move toward mean and spread of the best."""
        count = max(2, round(_ELITE_SHARE * len(candidates)))
        elite = candidates[torch.argsort(losses, stable=True)[:count]]
        mean = torch.lerp(known["mean"], elite.mean(0), _CEM_SMOOTHING)
        spread = torch.lerp(known["spread"], elite.std(0, correction=0), _CEM_SMOOTHING)
        return {"mean": mean, "spread": spread.clamp_min(_LEAST_SIGMA * self.sigma)}


@dataclass(frozen=True)
class Evolution:
    """Follow an estimate of the gradient of the smoothed loss, from antithetic pairs and ranks only.

    Salimans et al. 2017, "Evolution Strategies as a Scalable Alternative to Reinforcement Learning"; utilities of ranks after
    Wierstra et al. 2014, "Natural Evolution Strategies"; steps by Adam.

    Attributes:
        sigma: Spread of candidates around the mean, which starts grey.
        learning_rate: Of Adam.
    """

    sigma: float = 1.0
    learning_rate: float = 0.5
    name: str = "evolution"

    def fresh(self, shape: tuple[int, ...]) -> dict[str, Tensor]:
        """Grey, and Adam's moments."""
        return {"mean": torch.zeros(shape), "m": torch.zeros(shape), "v": torch.zeros(shape), "steps": torch.zeros(())}

    def ask(self, known: dict[str, Tensor], population: int, generator: torch.Generator) -> Tensor:
        """Pairs on opposite sides of the mean; of an odd number the last is alone."""
        half = torch.randn(((population + 1) // 2, *known["mean"].shape), generator=generator)
        return known["mean"] + self.sigma * torch.stack([half, -half], dim=1).flatten(0, 1)[:population]

    def tell(self, known: dict[str, Tensor], candidates: Tensor, losses: Tensor) -> dict[str, Tensor]:
        """One step of Adam against the estimated gradient."""
        away = (candidates - known["mean"]) / self.sigma
        weights = rank_utilities(losses).reshape(-1, *[1] * (away.ndim - 1))
        gradient = -(weights * away).sum(0) / self.sigma
        first, second, tiny = _ADAM
        steps = known["steps"] + 1
        m, v = torch.lerp(gradient, known["m"], first), torch.lerp(gradient**2, known["v"], second)
        corrected = m / (1 - first ** float(steps)), v / (1 - second ** float(steps))
        mean = known["mean"] - self.learning_rate * corrected[0] / (corrected[1].sqrt() + tiny)
        return {"mean": mean, "m": m, "v": v, "steps": steps}


def rank_utilities(losses: Tensor) -> Tensor:
    """Utilities ``[n]`` that depend on the order of the losses only: positive for the lowest, with sum zero."""
    count = len(losses)
    ranks = torch.empty(count)
    ranks[torch.argsort(losses, stable=True)] = torch.arange(1, count + 1, dtype=torch.float32)
    raw = (math.log(count / 2 + 1) - torch.log(ranks)).clamp_min(0.0)
    return raw / raw.sum() - 1.0 / count


def population_search(
    problem: AttackProblem,
    strategy: Strategy,
    evaluations: int = 50,
    population: int = 10,
    cells: int = 8,
    seed: int = 0,
    state_path: Path | None = None,
    on_evaluation: OnEvaluation | None = None,
    settings_hash: str = "",
) -> SearchResult:
    """Minimise the loss without its gradient, generation by generation; the best by predicted total CTE is kept.

    Args:
        problem: What is attacked.
        strategy: `CrossEntropy` or `Evolution`.
        evaluations: Rollouts in all, those of a resumed state included; a last generation may stay unfinished.
        population: Candidates of a generation.
        cells: See `Coarse`.
        seed: Of the candidates.
        state_path: State file, written after every evaluation; if it exists, the search goes on from it, to the bit.
        on_evaluation: Called after every evaluation.
        settings_hash: Hash of scene, policy and configuration; a state file of another one is refused.
    """
    if evaluations < 1 or population < 4:
        raise ValueError(f"expected evaluations >= 1 and a population >= 4, got {evaluations} and {population}")
    coarse = Coarse(tuple(problem.sensor.theta_shape), cells)
    fingerprint = search_fingerprint(
        problem, coarse.theta_shape, method=repr(strategy), seed=seed, population=population, cells=cells,
        hash=settings_hash,
    )  # fmt: skip
    generator = torch.Generator().manual_seed(seed)

    def generation(known: dict[str, Tensor]) -> dict[str, Tensor]:
        candidates = strategy.ask(known, population, generator)
        losses = torch.zeros(population, dtype=torch.float64)
        return {**known, "candidates": candidates, "losses": losses, "generator": generator.get_state()}

    state = begin(state_path, fingerprint, lambda: generation(strategy.fresh(coarse.shape)))
    generator.set_state(state.tensors["generator"])
    while len(state.history) < evaluations:
        evaluation = _evaluate_next(problem, state, coarse, population)
        if len(state.history) % population == 0:
            state.tensors = generation(_learned(strategy, state.tensors))
        if state_path is not None:
            state.save(state_path, fingerprint)
        if on_evaluation is not None:
            on_evaluation(evaluation)
    return state.result()


def _evaluate_next(problem: AttackProblem, state: SearchState, coarse: Coarse, population: int) -> Evaluation:
    began, number = time.perf_counter(), len(state.history)
    theta = coarse.expand(state.tensors["candidates"][number % population])
    loss_m, totals = without_gradient(problem, theta, number)
    state.tensors["losses"][number % population] = loss_m
    return state.record(theta, loss_m, totals, time.perf_counter() - began)


def _learned(strategy: Strategy, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    known = {key: value for key, value in tensors.items() if key not in ("candidates", "losses", "generator")}
    return strategy.tell(known, tensors["candidates"], tensors["losses"])
