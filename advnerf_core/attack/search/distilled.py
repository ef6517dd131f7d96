"""The method ``distilled``: the adjoint through a student that was trained on the victim's answers; see `black_box`."""

from __future__ import annotations

from advnerf_core.attack.methods import SearchRun, SearchSettings
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.attack.search.black_box import planned_evaluations, search_as
from advnerf_core.attack.search.record import SearchResult


def search(problem: AttackProblem, settings: SearchSettings, run: SearchRun) -> SearchResult:
    """The method; see `advnerf_core.attack.methods`."""
    return search_as("distilled", problem, settings, run)


def evaluations(problem: AttackProblem, settings: SearchSettings) -> int:
    """Drives that the budget allows; the queries about each drive count too."""
    return planned_evaluations("distilled", problem, settings)
