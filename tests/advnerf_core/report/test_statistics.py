import itertools
import math

import numpy as np
import pytest

from advnerf_core.report.statistics import (
    bootstrap,
    mean_and_std,
    ratio_interval,
    ratio_of_sums,
    transfer_interval,
)


def test_mean_and_sample_deviation_by_hand():
    assert mean_and_std([2.0, 4.0, 9.0]) == (5.0, math.sqrt(13.0))
    assert mean_and_std([3.0]) == (3.0, None)
    with pytest.raises(ValueError, match="at least one value"):
        mean_and_std([])


def test_the_ratio_is_of_sums_not_a_mean_of_ratios():
    assert ratio_of_sums([10.0, 2.0], [1.0, 5.0]) == 2.0
    assert ratio_of_sums([1.0], [0.0]) is None


def test_the_bootstrap_of_a_mean_of_few_is_the_exact_distribution_over_all_resamples():
    values = np.array([1.0, 5.0, 6.0, 10.0])
    exact = sorted(np.mean(chosen) for chosen in itertools.product(values, repeat=4))
    found = bootstrap(lambda chosen: values[chosen].mean(axis=1), 4)
    # 256 equally likely resamples: at most 2.5 % of them, that is 6, lie outside either end.
    assert found.low == exact[6]
    assert found.high == exact[249]


def test_the_bootstrap_of_a_mean_of_many_meets_the_normal_closed_form():
    values = np.random.default_rng(1).normal(3.0, 2.0, 400)
    found = bootstrap(lambda chosen: values[chosen].mean(axis=1), len(values))
    # Its variance is (n - 1) / n times the sample variance over n.
    half = 1.959964 * values.std(ddof=0) / math.sqrt(len(values))
    assert found.low == pytest.approx(values.mean() - half, abs=0.03 * half)
    assert found.high == pytest.approx(values.mean() + half, abs=0.03 * half)


def test_the_interval_covers_a_ratio_as_often_as_it_promises():
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(150):
        below = rng.uniform(4.0, 6.0, 30)
        above = 3.0 * below + rng.normal(0.0, 2.0, 30)
        found = ratio_interval(above, below)
        inside += found.low <= 3.0 <= found.high
    # Binomial(150, 0.95) leaves 130 ... 149 in 99.9 % of cases.
    assert 130 <= inside <= 150


def test_intervals_of_ratios_by_hand():
    # Two seeds: resamples (0,0), (0,1), (1,0), (1,1) with ratios 2, 8/3, 8/3, 3.
    found = ratio_interval([2.0, 6.0], [1.0, 2.0])
    assert (found.low, found.high) == (2.0, 3.0)
    # Where attacked and clean are proportional in both domains there is nothing uncertain.
    sure = transfer_interval(([4.0, 8.0], [1.0, 2.0]), ([6.0, 2.0], [3.0, 1.0]))
    assert sure.low == pytest.approx(2.0)
    assert sure.high == pytest.approx(2.0)


def test_what_has_no_interval_says_so():
    assert ratio_interval([2.0], [1.0]) is None
    assert ratio_interval([1.0, 2.0], [0.0, 1.0]) is None  # a resample may be all zero
    with pytest.raises(ValueError, match="one number per seed"):
        ratio_interval([1.0, 2.0], [1.0])
    with pytest.raises(ValueError, match="level within"):
        bootstrap(lambda chosen: chosen[:, 0] * 1.0, 3, level=1.0)
