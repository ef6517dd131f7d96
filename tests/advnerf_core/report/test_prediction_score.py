"""Scores of predicted bands, against sums by hand and scipy."""

import numpy as np
import pytest
from scipy import stats

from advnerf_core.report.evidence.prediction_score import (
    binomial_interval,
    interval_score,
    registered_bands,
    score_bands,
)
from advnerf_core.report.evidence.transfer_factor import Transfer


def test_the_interval_score_is_that_of_the_paper() -> None:
    # Width 2; one below by 1 costs 2 / 0.2 more, one above by 0.5 half of that.
    assert interval_score(1.0, 3.0, [2.0, 0.0, 3.5]) == pytest.approx([2.0, 12.0, 7.0])
    # It is proper: of a normal value the true quantiles score best.
    values = np.random.default_rng(0).normal(size=20_000)
    best = interval_score(-1.2816, 1.2816, values).mean()
    assert best < interval_score(-0.9, 0.9, values).mean()
    assert best < interval_score(-1.8, 1.8, values).mean()


def test_a_score_is_over_all_drives_of_a_set() -> None:
    bands = np.array([[[1.0, 3.0], [0.0, 1.0]], [[1.0, 3.0], [2.0, 4.0]]])
    found = score_bands(bands, np.array([[2.0, 0.5], [0.0, 4.0]]))
    assert (found.held, found.drives) == (3, 4)
    assert found.score == pytest.approx((2.0 + 1.0 + 12.0 + 2.0) / 4)


def test_registered_bands_are_in_half_lanes_and_of_every_search() -> None:
    drives = Transfer("set", ("one", "other"), np.ones((2, 3)), np.ones((2, 3)))
    said = {
        "one": {"excess_low_m": 0.1, "excess_high_m": 0.2},
        "other": {"excess_low_m": 0.3, "excess_high_m": 0.4},
    }
    found = registered_bands(drives, said, 0.5)
    assert found is not None
    assert found.shape == (2, 3, 2)
    assert found[1, 2] == pytest.approx([0.6, 0.8])
    assert registered_bands(drives, {"one": said["one"]}, 0.5) is None


@pytest.mark.parametrize(("held", "count"), [(0, 6), (5, 6), (6, 6), (27, 35)])
def test_the_binomial_interval_is_that_of_clopper_and_pearson(held: int, count: int) -> None:
    expected = stats.binomtest(held, count).proportion_ci(0.95, method="exact")
    assert binomial_interval(held, count) == pytest.approx((expected.low, expected.high))
    with pytest.raises(ValueError, match="expected some of at least one"):
        binomial_interval(7, 6)
