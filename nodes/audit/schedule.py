"""The order of an audit's searches and the shares of its budget: cheap and strong first, and successful methods get more.

A round searches at the best spots of the earlier rounds. Shares refer to the evaluations that the budget buys, which are
counted once, before the first search, so that a resumed run does the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from advnerf_core.attack.search.black_box import BlackBoxSearch


@dataclass(frozen=True)
class Round:
    """Searches of one method.

    Attributes:
        method: Name of the method.
        spots: Number of spots, the best of those searched before; in the first round, the most visible ones.
        starts: Number of starts of each search.
        share: Share of the budget.
    """

    method: str
    spots: int
    starts: int
    share: float


WITH_GRADIENT = (
    Round("gradient", spots=3, starts=1, share=0.3),
    Round("random_coarse", spots=1, starts=1, share=0.1),
    Round("gradient_coarse", spots=1, starts=1, share=0.2),
    Round("gradient", spots=1, starts=2, share=0.4),
)
# `gradient_coarse` needs a flat face.
WITH_GRADIENT_OF_A_SOLID = (
    Round("gradient", spots=3, starts=1, share=0.4),
    Round("random_coarse", spots=1, starts=1, share=0.1),
    Round("gradient", spots=1, starts=2, share=0.5),
)
BLACK_BOX = (
    Round("random_coarse", spots=3, starts=1, share=0.2),
    Round("cem", spots=2, starts=1, share=0.4),
    Round("guided", spots=1, starts=1, share=0.4),
)
# The student of `guided` learns from single images.
BLACK_BOX_WITH_MEMORY = (*BLACK_BOX[:2], Round("cem", spots=1, starts=1, share=0.4))
# Adam's rates: searches of an audit are short, so that they take larger steps than those of an experiment.
LEARNING_RATE = 0.5
_FEWEST, _FEWEST_CEM = 4, 20
_STEPS = 2  # of `guided` after the first lesson of its student, at least
# Methods that no schedule has; with the reason, for the report.
NEVER_TRIED = {
    "where the object stands, as part of a search": "the schedule searches colours at spots that a rule chose (space.kind places)",
    "the shape of the object": "shapes are searched over a world's own pictures only (space.kind mesh_shape)",
    "several objects at once": "one object is enough for the question; list more in the experiment file",
}


@dataclass(frozen=True)
class PlannedSearch:
    """One search of a round, at the spot of a rank."""

    round_: int
    spot: int
    seed: int
    evaluations: int


def rounds_for(differentiable: bool, flat: bool, remembers: bool = False) -> tuple[Round, ...]:
    """The schedule for a policy with or without a gradient, an object that is flat or not, and a policy with or without memory."""
    if not differentiable:
        return BLACK_BOX_WITH_MEMORY if remembers else BLACK_BOX
    return WITH_GRADIENT if flat else WITH_GRADIENT_OF_A_SOLID


def fewest(method: str, ticks: int) -> int:
    """Evaluations below which a method cannot begin, for drives of so many ticks."""
    if method == "guided":
        student = BlackBoxSearch.usual("guided")
        return math.ceil(student.first_calls() / ticks) + _STEPS * student.drives_per_step
    return _FEWEST_CEM if method == "cem" else _FEWEST


def planned(rounds: Sequence[Round], evaluations: int, ticks: int) -> list[list[PlannedSearch]]:
    """The searches of each round for so many evaluations of one start; an evaluation from several starts counts as many."""
    return [list(_of_round(number, each, evaluations, ticks)) for number, each in enumerate(rounds)]


def _of_round(number: int, wanted: Round, evaluations: int, ticks: int) -> Iterator[PlannedSearch]:
    each = int(wanted.share * evaluations / (wanted.spots * wanted.starts))
    for spot in range(wanted.spots):
        yield PlannedSearch(number, spot, 100 * number, max(fewest(wanted.method, ticks), each))
