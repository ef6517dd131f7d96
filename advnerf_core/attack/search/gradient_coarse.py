"""The method ``gradient_coarse``: the gradient attack in the coarse textures that ``cem`` and ``evolution`` search.

It separates the value of the gradient from the value of the finer texture: same parameters, same evaluations, other steps.
"""

from __future__ import annotations

from advnerf_core.attack.methods import SearchRun, SearchSettings
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.attack.search.gradient import adjoint_slope, climb
from advnerf_core.attack.search.population import Coarse
from advnerf_core.attack.search.record import SearchResult
from advnerf_core.attack.search.search import gradient_step
from advnerf_core.errors import AdvnerfError


class NoFinerFaceError(AdvnerfError, ValueError):
    """The object is not finer than the coarse texture."""


def search(problem: AttackProblem, settings: SearchSettings, run: SearchRun) -> SearchResult:
    """The method; see `advnerf_core.attack.methods`.

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
