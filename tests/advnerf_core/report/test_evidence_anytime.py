"""The anytime-valid test against enumeration of all orders, simulated draws, and simulated experiments."""

import itertools
import math

import numpy as np
import pytest

from advnerf_core.report.evidence.anytime import ODDS, anytime_test, e_value

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("counts", [(1, 1), (2, 2), (3, 3), (1, 3), (4, 2)])
def test_the_mean_e_value_over_all_orders_is_one(counts):
    orders = np.array(list(itertools.permutations(range(sum(counts)))), np.float64)
    found = e_value(orders[:, : counts[0]], orders[:, counts[0] :])
    assert found.mean() == pytest.approx(1.0)


def test_the_e_value_is_a_martingale_as_searches_are_added():
    # All orders of two pairs and a single search, grouped by the order of the first pairs.
    orders = np.array(list(itertools.permutations(range(5))), np.float64)
    ours, theirs, added = orders[:, :2], orders[:, 2:4], orders[:, 4:]
    before = e_value(ours, theirs)
    ranks = np.argsort(np.argsort(orders[:, :4], axis=1), axis=1) @ 4 ** np.arange(4)
    for after in (
        e_value(np.concatenate([ours, added], axis=1), theirs),
        e_value(ours, np.concatenate([theirs, added], axis=1)),
    ):
        for rank in np.unique(ranks):
            assert after[ranks == rank].mean() == pytest.approx(before[ranks == rank][0])


def test_the_e_value_is_the_ratio_of_the_chances_of_the_order():
    # With odds c, values of a are U^(1/c): the largest of c uniform values.
    count, found = 200_000, 0.0
    for odds in ODDS:
        ours, theirs = RNG.random((count, 2)) ** (1 / odds), RNG.random((count, 2))
        # a is first and third of four, from the largest downwards.
        found += np.mean(
            (ours.max(1) > theirs.max(1)) & (theirs.max(1) > ours.min(1)) & (ours.min(1) > theirs.min(1))
        )
    expected = float(e_value([4.0, 2.0], [3.0, 1.0]))
    assert math.comb(4, 2) * found / len(ODDS) == pytest.approx(expected, rel=0.03)


def test_separated_methods_are_told_apart_by_four_pairs_and_never_by_three():
    ours, theirs = np.arange(6) + 10.0, np.arange(6) * 1.0
    found = anytime_test(ours, theirs)
    assert (found.pairs, found.of_pairs) == (4, 6)
    assert found.p == pytest.approx(1.0 / float(e_value(ours, theirs)))
    assert anytime_test(ours[:3], theirs[:3]).pairs is None
    # Later searches take nothing back.
    assert anytime_test([*ours[:4], -1.0, -2.0], theirs).pairs == 4
    assert anytime_test(theirs, ours).p == 1.0


def test_values_that_differ_by_rounding_tie():
    assert anytime_test([0.1 + 0.2] * 6, [0.3] * 6) == anytime_test([0.3] * 6, [0.3] * 6)
    assert anytime_test([0.3 + 1e-9] * 6, [0.3] * 6).pairs == 4


def test_ties_count_against_the_method():
    assert float(e_value([1.0, 2.0], [1.0, 0.0])) == float(e_value([1.0, 2.0], [1.5, 0.0]))
    assert anytime_test(np.zeros(8), np.zeros(8)).p == 1.0


@pytest.mark.parametrize("draw", ["standard_normal", "standard_cauchy", "standard_exponential"])
def test_an_experiment_that_stops_when_it_likes_is_wrong_in_at_most_five_percent(draw):
    count, pairs = 20_000, 8
    ours, theirs = (getattr(RNG, draw)((count, pairs)) for _ in range(2))
    best = np.max([e_value(ours[:, :stop], theirs[:, :stop]) for stop in range(1, pairs + 1)], axis=0)
    assert np.mean(best >= 20.0) <= 0.05
    few = [anytime_test(a, b).pairs is not None for a, b in zip(ours[:300], theirs, strict=False)]
    assert few == list(best[:300] >= 20.0)


def test_what_is_no_list_of_searches_is_refused():
    for ours, theirs in (([[1.0]], [1.0]), ([], [1.0]), ([math.nan], [1.0])):
        with pytest.raises(ValueError, match="expected one finite mean for each search of both methods"):
            anytime_test(ours, theirs)
    with pytest.raises(ValueError, match="got 5; pass"):
        anytime_test([1.0], [0.0], 5)
