"""The method ``cem``: a normal distribution is refitted to the best candidates, generation by generation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.methods import SearchRun, SearchSettings
from advnerf_core.attack.search.population import search_with
from advnerf_core.attack.search.record import SearchResult

_SIGMA = 3.0
_ELITE_SHARE = 0.3
_CEM_SMOOTHING = 0.7
_LEAST_SIGMA = 0.1  # relative to the first one; a spread of zero finds nothing new


def search(problem: AttackProblem, settings: SearchSettings, run: SearchRun) -> SearchResult:
    """The method; see `advnerf_core.attack.methods`."""
    return search_with(CrossEntropy(settings.sigma or _SIGMA), problem, settings, run)


@dataclass(frozen=True)
class CrossEntropy:
    """Refit a normal distribution with a diagonal covariance to the best candidates.

    de Boer, Kroese, Mannor and Rubinstein 2005, "A Tutorial on the Cross-Entropy Method", with their smoothing.

    Attributes:
        sigma: First spread of every cell; the first mean is zero, which is grey.
    """

    sigma: float = _SIGMA
    name: str = "cem"

    def fresh(self, shape: tuple[int, ...]) -> dict[str, Tensor]:
        """Grey, and the first spread."""
        return {"mean": torch.zeros(shape), "spread": torch.full(shape, self.sigma)}

    def ask(self, known: dict[str, Tensor], population: int, generator: torch.Generator) -> Tensor:
        """Draw from the distribution."""
        return known["mean"] + known["spread"] * torch.randn(
            (population, *known["mean"].shape), generator=generator
        )

    def tell(self, known: dict[str, Tensor], candidates: Tensor, losses: Tensor) -> dict[str, Tensor]:
        """Move toward mean and spread of the best."""
        count = max(2, round(_ELITE_SHARE * len(candidates)))
        elite = candidates[torch.argsort(losses, stable=True)[:count]]
        mean = torch.lerp(known["mean"], elite.mean(0), _CEM_SMOOTHING)
        spread = torch.lerp(known["spread"], elite.std(0, correction=0), _CEM_SMOOTHING)
        return {"mean": mean, "spread": spread.clamp_min(_LEAST_SIGMA * self.sigma)}
