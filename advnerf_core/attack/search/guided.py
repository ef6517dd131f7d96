"""The method ``guided``: the victim's own slopes along a student's gradient and a few other directions; see `black_box`."""

from __future__ import annotations

from advnerf_core.attack.methods import SearchRun, SearchSettings
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.attack.search.black_box import planned_evaluations, search_as
from advnerf_core.attack.search.record import SearchResult


def search(problem: AttackProblem, settings: SearchSettings, run: SearchRun) -> SearchResult:
    """The method; see `advnerf_core.attack.methods`."""
    return search_as("guided", problem, settings, run)


def evaluations(problem: AttackProblem, settings: SearchSettings) -> int:
    """Drives that the budget allows; the queries about each drive count too."""
    return planned_evaluations("guided", problem, settings)
