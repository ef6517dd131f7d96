"""The schedule: what a budget buys, and that it never asks for less than a method can begin with."""

import pytest

from advnerf_core.attack.methods import black_box_methods
from advnerf_core.attack.search.black_box import BlackBoxSearch
from nodes.audit.schedule import (
    BLACK_BOX,
    BLACK_BOX_WITH_MEMORY,
    WITH_GRADIENT,
    WITH_GRADIENT_OF_A_SOLID,
    fewest,
    planned,
    rounds_for,
)


@pytest.mark.parametrize(
    "rounds", [WITH_GRADIENT, WITH_GRADIENT_OF_A_SOLID, BLACK_BOX, BLACK_BOX_WITH_MEMORY]
)
@pytest.mark.parametrize("evaluations", [200, 1000, 12345])
def test_a_budget_is_spent_and_not_exceeded(rounds, evaluations):
    row_costs = [
        sum(search.evaluations * wanted.starts for search in row)
        for wanted, row in zip(rounds, planned(rounds, evaluations, 60), strict=True)
    ]
    assert 0.9 * evaluations <= sum(row_costs) <= evaluations


@pytest.mark.parametrize(
    "rounds", [WITH_GRADIENT, WITH_GRADIENT_OF_A_SOLID, BLACK_BOX, BLACK_BOX_WITH_MEMORY]
)
def test_shares_are_of_the_whole(rounds):
    assert sum(each.share for each in rounds) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "rounds", [WITH_GRADIENT, WITH_GRADIENT_OF_A_SOLID, BLACK_BOX, BLACK_BOX_WITH_MEMORY]
)
def test_a_tiny_budget_still_lets_every_method_begin(rounds):
    for wanted, row in zip(rounds, planned(rounds, 1, 60), strict=True):
        assert all(search.evaluations >= fewest(wanted.method, 60) for search in row)


def test_no_search_has_the_seed_of_another():
    seeds = [search.seed + 1000 * search.spot for row in planned(WITH_GRADIENT, 100, 60) for search in row]
    assert len(set(seeds)) == len(seeds)


@pytest.mark.parametrize("ticks", [10, 40, 60])
def test_the_student_gets_the_calls_that_it_needs_to_begin(ticks: int) -> None:
    calls = fewest("guided", ticks) * ticks
    student = BlackBoxSearch.usual("guided")
    assert calls >= student.first_calls() + ticks * (1 + 2 * student.probes)


def test_only_flat_objects_are_searched_by_a_coarse_picture() -> None:
    assert rounds_for(differentiable=True, flat=True) == WITH_GRADIENT
    assert "gradient_coarse" not in {each.method for each in rounds_for(differentiable=True, flat=False)}
    assert rounds_for(differentiable=False, flat=False) == BLACK_BOX
    methods = {each.method for each in rounds_for(differentiable=False, flat=True, remembers=True)}
    assert methods <= set(black_box_methods(stateless=False))
    assert not {each.method for each in BLACK_BOX} <= set(black_box_methods(stateless=False))
