"""The method ``evolution``: an evolution strategy, which estimates the gradient of the smoothed loss from ranks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.methods import SearchRun, SearchSettings
from advnerf_core.attack.search.population import search_with
from advnerf_core.attack.search.record import SearchResult

_SIGMA, _LEARNING_RATE = 1.0, 0.5
_ADAM = (0.9, 0.999, 1e-8)


def search(problem: AttackProblem, settings: SearchSettings, run: SearchRun) -> SearchResult:
    """The method; see `advnerf_core.attack.methods`."""
    strategy = Evolution(settings.sigma or _SIGMA, settings.learning_rate or _LEARNING_RATE)
    return search_with(strategy, problem, settings, run)


@dataclass(frozen=True)
class Evolution:
    """Follow an estimate of the gradient of the smoothed loss, from antithetic pairs and ranks only.

    Salimans et al. 2017, "Evolution Strategies as a Scalable Alternative to Reinforcement Learning"; utilities of ranks after
    Wierstra et al. 2014, "Natural Evolution Strategies"; steps by Adam.

    Attributes:
        sigma: Spread of candidates around the mean, which starts grey.
    """

    sigma: float = _SIGMA
    learning_rate: float = _LEARNING_RATE
    name: str = "evolution"

    def fresh(self, shape: tuple[int, ...]) -> dict[str, Tensor]:
        """Grey, and Adam's moments."""
        return {
            "mean": torch.zeros(shape),
            "m": torch.zeros(shape),
            "v": torch.zeros(shape),
            "steps": torch.zeros(()),
        }

    def ask(self, known: dict[str, Tensor], population: int, generator: torch.Generator) -> Tensor:
        """Pairs on opposite sides of the mean; the last of an odd number is single."""
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
