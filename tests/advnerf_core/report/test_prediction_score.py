"""Scores of predicted bands, against sums by hand."""

import numpy as np
import pytest

from advnerf_core.report.predictions import interval_score, score_bands


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
