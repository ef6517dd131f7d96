"""Exact tests against closed forms and against scipy."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from advnerf_core.report.evidence.exact import (
    FEW_SEARCHES,
    McNemar,
    holm,
    mcnemar_exact,
    mcnemar_per_search,
    permutation_test,
)

BETTER, WORSE = [3.1, 2.2, 4.7, 5.0, 2.9, 6.3], [0.2, 1.1, 0.4, -0.3, 2.1, 0.9]


def difference(a, b, axis):
    return np.mean(a, axis=axis) - np.mean(b, axis=axis)


def by_scipy(a, b):
    found = stats.permutation_test(
        (a, b), difference, vectorized=True, n_resamples=np.inf, alternative="greater"
    )
    return float(found.pvalue)


def test_six_that_are_all_better_than_six_reach_one_in_924():
    found = permutation_test(BETTER, WORSE)
    assert (found.p, found.reason) == (1 / 924, "")
    assert found.difference == pytest.approx(np.mean(BETTER) - np.mean(WORSE))
    assert permutation_test(WORSE, BETTER).p == 1.0


def test_means_that_differ_by_rounding_are_equal():
    """As those of the same drives in another order, where all cars are held at the cap."""
    drives = np.round(np.random.default_rng(0).normal(0.3, 0.1, 20), 3)
    orders = np.random.default_rng(1).permuted(np.tile(drives, (40, 1)), axis=1)
    means = np.array([float(np.cumsum(each)[-1]) / 20 for each in orders])
    assert len(set(means)) > 1
    high, low = np.sort(means)[-6:], np.sort(means)[:6]
    assert permutation_test(high, low).p == 1.0
    assert permutation_test([0.1 + 0.2] * 6, [0.3] * 6).p == 1.0


def test_ties_count_against_a():
    assert permutation_test([0.1] * 6, [0.1] * 6).p == 1.0
    # a holds the one large value in half of all splits.
    assert permutation_test([0.3] * 5 + [0.7], [0.3] * 6).p == 0.5


@pytest.mark.parametrize("sizes", [(6, 6), (7, 6), (6, 9)])
def test_the_permutation_test_agrees_with_scipy(sizes):
    rng = np.random.default_rng(sum(sizes))
    for shift in (0.0, 0.8):
        a, b = rng.normal(shift, 1.0, sizes[0]), rng.normal(0.0, 1.0, sizes[1])
        assert permutation_test(a, b).p == pytest.approx(by_scipy(a, b), abs=1e-12)
    # Tenths tie up to rounding. Near zero scipy has no tolerance for that, so it gets whole numbers, which tie exactly.
    whole, other = rng.integers(0, 4, sizes[0]), rng.integers(0, 4, sizes[1])
    assert permutation_test(whole / 10, other / 10).p == pytest.approx(by_scipy(whole, other), abs=1e-12)


MEANS = st.lists(st.integers(-40, 40).map(lambda x: x / 8), min_size=6, max_size=7)


@given(MEANS, MEANS, st.integers(-8, 8))
def test_the_permutation_test_does_not_depend_on_origin_or_order(a, b, shift):
    found = permutation_test(a, b)
    assert 1 / math.comb(len(a) + len(b), len(a)) <= found.p <= 1.0
    moved = permutation_test([x + 1000.0 * shift for x in reversed(a)], [x + 1000.0 * shift for x in b])
    assert moved.p == found.p
    # Both directions together count every split, and ties twice.
    assert found.p + permutation_test(b, a).p >= 1.0 - 1e-12


def test_the_permutation_test_rejects_no_more_than_its_level():
    rng = np.random.default_rng(0)
    ps = [permutation_test(*rng.exponential(1.0, (2, 6))).p for _ in range(2_000)]
    # The exact rate is 46 / 924; binomial chance of 2,000 replications leaves 3.4 to 6.6 % in 99.9 % of cases.
    assert 0.034 <= np.mean(np.array(ps) <= 0.05) <= 0.066


def test_fewer_than_six_searches_claim_no_test():
    for a, b in ((BETTER[:5], WORSE), (BETTER, WORSE[:5]), ([1.0], [0.0] * 2_000)):
        found = permutation_test(a, b)
        assert (found.p, found.reason) == (None, FEW_SEARCHES)
        assert found.difference == pytest.approx(np.mean(a) - np.mean(b))
    assert FEW_SEARCHES == "With fewer than six searches no test is claimed"


def test_too_many_splits_are_refused():
    with pytest.raises(
        ValueError, match=r"at most 1000000 splits of the searches, got 2704156 from 12 and 12"
    ):
        permutation_test(np.zeros(12), np.ones(12))


@pytest.mark.parametrize("bad", [[], [[1.0] * 6], [1.0] * 5 + [math.nan], 3.0])
def test_search_means_are_one_finite_row(bad):
    with pytest.raises(ValueError, match=r"one finite mean for each search of b \[n\], got shape"):
        permutation_test(BETTER, bad)
    with pytest.raises(ValueError, match=r"one finite mean for each search of a \[n\], got shape"):
        permutation_test(bad, WORSE)


def test_mcnemar_by_hand():
    assert mcnemar_exact(0, 0) == 1.0
    assert mcnemar_exact(5, 0) == 2 / 32
    assert mcnemar_exact(1, 5) == 2 * (1 + 6) / 64
    assert mcnemar_exact(3, 3) == 1.0


@given(st.integers(0, 60), st.integers(0, 60))
def test_mcnemar_is_the_binomial_test_of_discordant_pairs(only_a, only_b):
    assert mcnemar_exact(only_a, only_b) == mcnemar_exact(only_b, only_a)
    if only_a + only_b:
        expected = stats.binomtest(only_a, only_a + only_b, 0.5).pvalue
        assert mcnemar_exact(only_a, only_b) == pytest.approx(expected)


def test_mcnemar_of_thousands_of_pairs_is_exact():
    assert mcnemar_exact(2_400, 2_600) == pytest.approx(stats.binomtest(2_400, 5_000, 0.5).pvalue)


@pytest.mark.parametrize("bad", [(-1, 2), (2, -1), (1.5, 2), (True, 1), ("1", 2)])
def test_mcnemar_takes_counts(bad):
    with pytest.raises(ValueError, match="two counts of pairs, got"):
        mcnemar_exact(*bad)


def test_mcnemar_per_search_pairs_the_drives_by_start():
    attack = np.array([[True] * 6 + [False] * 2, [True, False] * 4])
    baseline = np.array([[False] * 7 + [True], [True, False] * 4])
    assert mcnemar_per_search(attack, baseline) == (McNemar(6, 1, mcnemar_exact(6, 1)), McNemar(0, 0, 1.0))


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        (np.ones((2, 3), bool), np.ones((2, 2), bool), r"got shapes \[2, 3\] and \[2, 2\]; drive both"),
        (np.ones((2, 3), bool), np.ones(3, bool), r"got shapes \[2, 3\] and \[3\]"),
        (np.ones(3, bool), np.ones(3, bool), r"got shapes \[3\] and \[3\]"),
        (np.ones((0, 3), bool), np.ones(3, bool), r"got shapes \[0, 3\] and \[3\]"),
        (np.ones((2, 3)), np.ones((2, 3), bool), "of type bool, got float64 and bool; compare"),
    ],
)
def test_off_track_flags_of_other_starts_or_types_are_refused(a, b, message):
    with pytest.raises(ValueError, match=message):
        mcnemar_per_search(a, b)


def test_holm_by_hand():
    # Ascending 0.005, 0.01, 0.03, 0.04 times 4, 3, 2, 1; the last may not fall below the one before it.
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx((0.03, 0.06, 0.06, 0.02))
    assert holm([0.2]) == (0.2,)
    assert holm([0.5, 0.6, 0.7]) == (1.0, 1.0, 1.0)


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_holm_lies_between_the_p_values_and_bonferroni_and_keeps_their_order(ps):
    adjusted = holm(ps)
    assert all(p <= new <= min(1.0, len(ps) * p) for p, new in zip(ps, adjusted, strict=True))
    order = np.argsort(ps, kind="stable")
    assert (np.diff(np.array(adjusted)[order]) >= 0.0).all()


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=8), st.sampled_from([0.01, 0.05, 0.2]))
def test_holm_rejects_what_the_step_down_procedure_rejects(ps, alpha):
    rejected, left = set(), sorted(range(len(ps)), key=lambda k: ps[k])
    while left and len(left) * ps[left[0]] <= alpha:
        rejected.add(left.pop(0))
    assert {k for k, p in enumerate(holm(ps)) if p <= alpha} == rejected


@pytest.mark.parametrize("bad", [[], [0.1, None], [0.1, math.nan], [1.1], [-0.1]])
def test_holm_takes_a_p_value_of_every_registered_test(bad):
    with pytest.raises(ValueError, match=r"one p-value within 0..1 for each registered test, got"):
        holm(bad)
