"""Clustered intervals against closed forms, scipy, and measured coverage."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import optimize, stats

from advnerf_core.report.evidence.intervals import (
    MEASURED_COVERAGE,
    clustered_interval,
    difference_interval,
)
from advnerf_core.report.evidence.mean_estimate import crossed, difference, one_sample
from benchmarks.coverage import p_above, p_below
from benchmarks.results import read_rows

RNG = np.random.default_rng(0)
SYMMETRIC = [0.1, 0.2, 0.4, 0.6, 0.8, 0.9]
SKEWED = [0.1, 0.2, 0.25, 0.3, 0.5, 1.9]


def additive(of_searches, of_starts):
    """Drives ``[searches, starts]`` without noise."""
    return np.add.outer(np.asarray(of_searches), np.asarray(of_starts))


def t_interval(estimate, level=0.95):
    """The same estimate's interval without the correction for skewness."""
    low, high = dataclasses.replace(estimate, skewness=np.zeros_like(estimate.skewness)).ends(level)
    return float(low), float(high)


@pytest.mark.parametrize("level", [0.5, 0.9, 0.95, 0.99])
def test_symmetric_search_means_from_own_starts_give_the_t_interval(level):
    rows = [[mean - 0.05, mean, mean + 0.05] for mean in SYMMETRIC]
    found = clustered_interval(rows, level, shared_starts=False)
    low, high = stats.t.interval(level, 5, np.mean(SYMMETRIC), stats.sem(SYMMETRIC))
    assert (found.low, found.high) == (pytest.approx(low), pytest.approx(high))
    assert found.over == "searches and starts"


def test_searches_with_starts_of_their_own_may_have_different_numbers_of_them():
    rows = [[mean] * count for count, mean in enumerate(SYMMETRIC, start=1)]
    found = clustered_interval(rows, shared_starts=False)
    low, high = stats.t.interval(0.95, 5, np.mean(SYMMETRIC), stats.sem(SYMMETRIC))
    assert (found.mean, found.low, found.high) == pytest.approx((np.mean(SYMMETRIC), low, high))


def test_one_search_speaks_for_starts_alone_and_one_start_for_searches_alone():
    one_search, one_start = clustered_interval([SYMMETRIC]), clustered_interval([[x] for x in SYMMETRIC])
    assert (one_search.over, one_start.over) == ("starts", "searches")
    expected = stats.t.interval(0.95, 5, np.mean(SYMMETRIC), stats.sem(SYMMETRIC))
    for found in (one_search, one_start):
        assert (found.low, found.high) == pytest.approx(expected)
    assert clustered_interval([SYMMETRIC], shared_starts=False).over == "starts"


@pytest.mark.parametrize("shared", [True, False])
def test_a_single_drive_has_no_interval(shared):
    assert clustered_interval([[0.3]], shared_starts=shared) is None


def test_additive_effects_give_the_welch_interval_of_two_samples():
    # mean = mean(a) + mean(b), with independent samples of searches and starts: Welch's test of a against -b.
    for of_searches, of_starts in (
        (SKEWED, RNG.exponential(1.0, 20)),
        (RNG.normal(size=3), RNG.normal(size=9)),
    ):
        estimate = crossed(additive(of_searches, of_starts))
        welch = stats.ttest_ind(of_searches, -np.asarray(of_starts), equal_var=False)
        assert float(estimate.degrees_of_freedom) == pytest.approx(welch.df)
        assert t_interval(estimate) == pytest.approx(tuple(welch.confidence_interval(0.95)))


def test_the_skewness_of_additive_effects_is_that_of_both_samples():
    starts = RNG.exponential(1.0, 20)
    estimate = crossed(additive(SKEWED, starts))
    third = sum(
        stats.skew(sample, bias=False) * np.std(sample, ddof=1) ** 3 / len(sample) ** 2
        for sample in (SKEWED, starts)
    )
    assert float(estimate.skewness) == pytest.approx(third / float(estimate.standard_error) ** 3)


def test_the_squared_standard_error_is_searches_plus_starts_minus_residual():
    drives = additive(RNG.normal(0, 1, 4), RNG.normal(0, 2, 7)) + RNG.normal(0, 0.3, (4, 7))
    rows, columns, mean = drives.mean(axis=1), drives.mean(axis=0), drives.mean()
    left = sum((drives[i, j] - rows[i] - columns[j] + mean) ** 2 for i in range(4) for j in range(7))
    parts = (
        sum((rows - mean) ** 2) / (3 * 4),
        sum((columns - mean) ** 2) / (6 * 7),
        -left / (3 * 6) / 28,
    )
    found = crossed(drives)
    assert float(found.standard_error) == pytest.approx(math.sqrt(sum(parts)))
    freedom = sum(parts) ** 2 / sum(part**2 / df for part, df in zip(parts, (3, 6, 18), strict=True))
    assert float(found.degrees_of_freedom) == pytest.approx(freedom)


def test_an_effect_that_the_data_do_not_show_leaves_one_sample():
    # The residual of a chessboard averages out over searches: they do not differ, and the starts are the sample.
    board = 0.5 * (-1.0) ** np.add.outer(np.arange(4), np.arange(6))
    starts = np.array([0.0, 1.0, 2.0, 3.0, 5.0, 9.0])
    for drives, sample in ((board + starts, starts), ((board + starts).T, starts)):
        found, direct = clustered_interval(drives), one_sample(sample)
        assert (found.low, found.high) == pytest.approx(tuple(float(end) for end in direct.ends(0.95)))
        assert float(crossed(drives).degrees_of_freedom) == 5
        assert found.over == "searches and starts"
    alone = crossed(board)
    assert (alone.degrees_of_freedom, alone.standard_error) == (23, pytest.approx(stats.sem(board.ravel())))


def test_skewed_values_give_the_interval_that_inverts_halls_cubic():
    found = clustered_interval([SKEWED])
    error, quantile = stats.sem(SKEWED), stats.t.ppf(0.975, 5)
    g = stats.skew(SKEWED, bias=False) / math.sqrt(6)

    def cubic(t):
        return t + g * t**2 / 3 + g**2 * t**3 / 27 + g / 6

    for end, target in ((found.low, quantile), (found.high, -quantile)):
        t = optimize.brentq(lambda t, target=target: cubic(t) - target, -50.0, 50.0, xtol=1e-13)
        assert end == pytest.approx(found.mean - error * t)
    assert found.high - found.mean > found.mean - found.low


DRIVES = arrays(
    np.float64,
    st.tuples(st.integers(1, 6), st.integers(2, 6)),
    elements=st.floats(-5.0, 5.0).map(lambda x: round(x, 2)),
)


@given(DRIVES, st.floats(-3.0, 3.0), st.floats(0.1, 10.0))
def test_an_interval_moves_and_scales_with_its_values_and_turns_with_their_sign(drives, shift, scale):
    plain, moved, turned = (clustered_interval(x) for x in (drives, scale * drives + shift, -drives))
    if plain.high - plain.low < 1e-9:
        return
    # Which effects are dropped is decided by comparing mean squares; where they tie, rounding decides.
    if drives.shape[0] > 1 and _has_ties(drives):
        return
    assert (moved.low, moved.high) == pytest.approx(
        (scale * plain.low + shift, scale * plain.high + shift), rel=1e-6, abs=1e-6
    )
    assert (turned.low, turned.high) == pytest.approx((-plain.high, -plain.low), rel=1e-6, abs=1e-6)


def _has_ties(drives):
    rows, columns = drives.mean(axis=1, keepdims=True), drives.mean(axis=0, keepdims=True)
    searches, starts = drives.shape
    left = ((drives - rows - columns + drives.mean()) ** 2).sum() / ((searches - 1) * (starts - 1))
    squares = starts * rows.var(ddof=1), searches * columns.var(ddof=1)
    return any(abs(square - left) < 1e-6 * (square + left) for square in squares)


@given(DRIVES, st.floats(0.5, 0.9), st.floats(0.91, 0.999))
def test_an_interval_holds_every_interval_of_a_lower_level(drives, lower, higher):
    inner, outer = clustered_interval(drives, lower), clustered_interval(drives, higher)
    assert outer.low <= inner.low <= inner.high <= outer.high


def test_searches_and_starts_play_the_same_part():
    drives = additive(RNG.normal(0, 1, 5), RNG.normal(0, 1, 8)) + RNG.normal(0, 1, (5, 8))
    one, other = clustered_interval(drives), clustered_interval(drives.T)
    assert (one.low, one.high) == pytest.approx((other.low, other.high))


@pytest.mark.parametrize(
    ("deviations", "transform", "truth"),
    [
        ((1.0, 1.0, 1.0), lambda x: x, 0.0),
        ((0.0, 1.0, 1.0), lambda x: x, 0.0),
        ((0.3, 1.0, 0.3), lambda x: x, 0.0),
        ((0.3, 0.3, 0.3), np.exp, math.exp(0.135)),
    ],
)
def test_intervals_of_six_searches_from_twenty_starts_cover_93_to_97_percent(deviations, transform, truth):
    rng, count = np.random.default_rng(3), 8_000
    effects = deviations[0] * rng.standard_normal((count, 6, 1))
    effects = effects + deviations[1] * rng.standard_normal((count, 1, 20))
    drives = transform(effects + deviations[2] * rng.standard_normal((count, 6, 20)))
    low, high = crossed(drives).ends(0.95)
    # Chance of 8,000 replications: 0.25 points.
    assert 0.93 <= np.mean((low <= truth) & (truth <= high)) <= 0.97
    first = clustered_interval(drives[0])
    assert (first.low, first.high) == pytest.approx((float(low[0]), float(high[0])))


def test_one_sided_p_values_are_those_of_t_tests():
    estimate = one_sample(np.array(SYMMETRIC))
    for bound in (-0.55, 0.3, 1.5):
        for found, side in ((p_above(estimate, bound), "greater"), (p_below(estimate, bound), "less")):
            expected = stats.ttest_1samp(SYMMETRIC, bound, alternative=side).pvalue
            assert float(found) == pytest.approx(expected)
    flat = crossed(np.full((6, 20), 0.25))
    assert (float(p_above(flat, 0.1)), float(p_below(flat, 0.1))) == (0.0, 1.0)


def test_values_without_spread_have_an_interval_of_zero_width():
    found = clustered_interval(np.full((6, 20), 0.25))
    assert (found.low, found.high) == (0.25, 0.25)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], r"at least one start for each search, got shapes \[\]; pass \[\[...\]\]"),
        ([0.1, 0.2], r"got shapes \[\[\], \[\]\]"),
        ([[0.1], []], r"got shapes \[\[1\], \[0\]\]"),
        ([[[0.1]]], r"got shapes \[\[1, 1\]\]"),
        ([[0.1, math.nan]], "finite values, got NaN or infinity; repeat"),
        ([[0.1, 0.2], [0.3]], r"same starts for all searches, got rows of \[1, 2\] starts; keep the starts"),
    ],
)
def test_values_that_are_no_table_of_searches_and_starts_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        clustered_interval(values)


@pytest.mark.parametrize("level", [0.0, 1.0, 95.0, math.nan])
def test_a_level_is_within_0_and_1(level):
    with pytest.raises(ValueError, match=r"level within 0..1, got .*; pass 0.95"):
        clustered_interval([SYMMETRIC], level)


def two_methods(rng, count=(), searches=(6, 6), starts=20, varies=(0.3, 0.3), common=0.3, own=0.2, noise=0.3):
    """Drives of two methods from shared starts, whose true means are equal."""
    shared = common * rng.standard_normal((*count, 1, starts))
    return [
        shared
        + own * rng.standard_normal((*count, 1, starts))
        + each * rng.standard_normal((*count, number, 1))
        + noise * rng.standard_normal((*count, number, starts))
        for number, each in zip(searches, varies, strict=True)
    ]


@given(
    st.integers(0, 10_000), st.permutations(range(6)), st.permutations(range(4)), st.permutations(range(5))
)
def test_the_interval_of_a_difference_does_not_depend_on_the_order_of_searches(seed, mine, theirs, starts):
    one, other = two_methods(np.random.default_rng(seed), searches=(6, 4), starts=5)
    found = difference_interval(one, other)
    moved = difference_interval(one[mine][:, starts], other[theirs][:, starts])
    assert (moved.low, moved.high) == pytest.approx((found.low, found.high))
    turned = difference_interval(other, one)
    assert (turned.low, turned.high) == pytest.approx((-found.high, -found.low))


def test_a_difference_without_start_effects_is_welchs():
    one, other = RNG.normal(0, 1, 6), RNG.normal(3, 0.2, 4)
    estimate = difference(np.repeat(one[:, None], 5, axis=1), np.repeat(other[:, None], 5, axis=1))
    welch = stats.ttest_ind(one, other, equal_var=False)
    assert float(estimate.degrees_of_freedom) == pytest.approx(welch.df)
    assert t_interval(estimate) == pytest.approx(tuple(welch.confidence_interval(0.95)))


def test_a_difference_between_searches_that_are_alike_is_a_paired_test_over_starts():
    shared, extra = RNG.normal(0, 5, 9), RNG.normal(1, 1, 9)
    estimate = difference(np.repeat((shared + extra)[None], 6, axis=0), np.repeat(shared[None], 3, axis=0))
    paired = stats.ttest_1samp(extra, 0.0)
    assert float(estimate.degrees_of_freedom) == pytest.approx(paired.df)
    assert t_interval(estimate) == pytest.approx(tuple(paired.confidence_interval(0.95)))


def test_the_squared_standard_error_of_a_difference_is_that_of_its_parts():
    rng = np.random.default_rng(4)
    pair = two_methods(rng, searches=(5, 3), starts=7, varies=(1.0, 2.0), own=1.5)
    starts = np.array([pair[0][:, j].mean() - pair[1][:, j].mean() for j in range(7)])
    parts = [(sum((starts - starts.mean()) ** 2) / 6 / 7, 6)]
    for drives in pair:
        count = len(drives)
        rows, columns, mean = drives.mean(axis=1), drives.mean(axis=0), drives.mean()
        left = sum((drives[i, j] - rows[i] - columns[j] + mean) ** 2 for i in range(count) for j in range(7))
        parts.append((sum((rows - mean) ** 2) / (count - 1) / count, count - 1))
        parts.append((-left / ((count - 1) * 6) / (7 * count), (count - 1) * 6))
    found = difference(*pair)
    total = sum(part for part, _ in parts)
    assert float(found.standard_error) == pytest.approx(math.sqrt(total))
    assert float(found.degrees_of_freedom) == pytest.approx(
        total**2 / sum(part**2 / freedom for part, freedom in parts)
    )
    assert difference_interval(*pair).over == "searches and starts"


@pytest.mark.parametrize(
    "design",
    [
        {},
        {"varies": (0.02, 0.3), "noise": 0.1},
        {"searches": (3, 6), "starts": 8},
        {"varies": (0.05, 0.05), "own": 0.3, "noise": 0.1},
    ],
)
def test_intervals_of_a_difference_cover_93_to_97_percent(design):
    one, other = two_methods(np.random.default_rng(5), count=(6_000,), **design)
    low, high = difference(one, other).ends(0.95)
    assert 0.93 <= np.mean((low <= 0.0) & (high >= 0.0)) <= 0.97
    first = difference_interval(one[0], other[0])
    assert (first.low, first.high) == pytest.approx((float(low[0]), float(high[0])))


def test_a_difference_of_single_searches_has_no_interval_and_other_starts_are_refused():
    assert difference_interval([SYMMETRIC], [SKEWED, SKEWED]) is None
    assert difference_interval([[0.1], [0.2]], [[0.3], [0.4]]) is None
    with pytest.raises(ValueError, match="expected the same starts for both methods, got 6 and 5"):
        difference_interval([SYMMETRIC] * 2, [SKEWED[:5]] * 2)


def test_the_coverage_that_pages_name_is_the_measured_one():
    named = f"searches x {20} starts"
    measured = [
        row["value"]
        for row in read_rows()
        if row["line"].startswith("95 % interval") and f"6 {named}" in row["line"] and row["met"] is not None
    ]
    assert len(measured) > 15
    assert (round(min(measured)), round(max(measured))) == MEASURED_COVERAGE
