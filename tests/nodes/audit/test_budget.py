"""A budget in minutes: what judging costs is kept back first, and as much again as a search for a planted weakness."""

import pytest

from nodes.audit.budget import Costs
from nodes.audit.question import AuditedQuestion, Place

WORLD = Place("lab", "world", "lab", "world", {"kind": "lab"})
PHOTOGRAPHS = Place("the place of photos", "images", "photos", "poses", {"kind": "photographs"})
COSTS = Costs(evaluation_s=2.0, learned_s=1.0, film_s=30.0, world_s=3.0, opening_s=10.0)
SEARCHES = 6


def question(place: Place) -> AuditedQuestion:
    return AuditedQuestion("file.onnx", "file.onnx", place, 0.4, judging=20)


@pytest.mark.parametrize("place", [WORLD, PHOTOGRAPHS])
def test_searches_for_an_object_and_a_planted_weakness_and_the_judging_fill_the_budget(place: Place) -> None:
    asked, left_s = question(place), 1800.0
    count = COSTS.evaluations(left_s, asked, SEARCHES)
    search_s = count * COSTS.evaluation_s + COSTS.choosing_s(SEARCHES)
    used_s = 2.0 * search_s + COSTS.judging_s(asked)
    assert left_s - 2.0 * COSTS.evaluation_s < used_s <= left_s


def test_a_slow_world_is_judged_in_time_that_the_searches_do_not_get() -> None:
    slow = Costs(COSTS.evaluation_s, COSTS.learned_s, COSTS.film_s, world_s=15.0, opening_s=60.0)
    asked = question(WORLD)
    assert slow.judging_s(asked) > 20 * 4 * 15.0, "four arms of 20 drives in the world"
    assert slow.evaluations(1800.0, asked, SEARCHES) < COSTS.evaluations(1800.0, asked, SEARCHES)


@pytest.mark.parametrize("left_s", [-100.0, 0.0, 100.0])
def test_a_budget_below_the_judging_still_buys_the_smallest_schedule(left_s: float) -> None:
    assert COSTS.evaluations(left_s, question(WORLD), SEARCHES) == 1
