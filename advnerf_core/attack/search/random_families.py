"""Random textures with spatial structure: the methods ``random_coarse``, ``random_levels``, ``random_pink`` and ``random_natural``.

They are ``random`` with other pictures: as many evaluations, the same spread of theta, the best is kept. So a gradient that beats them cannot owe it
to smoothness, to large areas of one colour, or to edges alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from advnerf_core.attack.methods import SearchRun, SearchSettings
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.attack.search import textures
from advnerf_core.attack.search.random_search import best_drawn
from advnerf_core.attack.search.record import SearchResult
from advnerf_core.attack.search.search import random_spread
from advnerf_core.fields.colour_grid import colour_grid

_FAMILIES = {
    "random_levels": textures.levels,
    "random_pink": textures.pink,
    "random_natural": textures.natural,
}


def search(method: str, problem: AttackProblem, settings: SearchSettings, run: SearchRun) -> SearchResult:
    """The methods; see `advnerf_core.attack.methods`."""
    coarse = method == "random_coarse"
    family = textures.coarse(settings.cells) if coarse else _FAMILIES[method]
    own = {"cells": settings.cells} if coarse else {}
    grids = [colour_grid(field) for field in problem.coloured(method).objects]
    shape, sigma = problem.sensor.theta_shape, random_spread(problem, settings)

    def draw(generator: torch.Generator) -> Tensor:
        return sigma * torch.cat([family(grid, generator) for grid in grids]).reshape(shape)

    return best_drawn(problem, draw, settings.evaluations, run, method=method, sigma=sigma, **own)
