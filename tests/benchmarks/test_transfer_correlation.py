"""Correlations of learned and deployed excess, against scipy and against a regression with one constant per set."""

import numpy as np
import pytest
from scipy.stats import pearsonr, spearmanr

from advnerf_core.report.evidence.verifying.layout import sets_in
from benchmarks.predictions import PUBLISHED, evidence_of
from benchmarks.transfer_correlation import SetPoints, correlation, line, lower_bound, points_of


def sets_of(slope: float, noise: float, offsets: tuple[float, ...], seed: int = 3) -> list[SetPoints]:
    rng, found = np.random.default_rng(seed), []
    for number, offset in enumerate(offsets):
        x = rng.uniform(0.0, 1.0, 12) + offset
        y = slope * x + rng.normal(0.0, noise, 12) - 2.0 * slope * offset
        found.append(SetPoints(f"set{number}", number, np.stack([x, y], axis=1)))
    return found


def test_pooled_is_what_scipy_says() -> None:
    sets = sets_of(0.7, 0.2, (0.0, 0.4, 1.0))
    both = np.concatenate([each.xy for each in sets])
    assert correlation(sets, False, False) == pytest.approx(pearsonr(*both.T).statistic)
    assert correlation(sets, False, True) == pytest.approx(spearmanr(*both.T).statistic)
    assert line(sets, False) == pytest.approx(np.polyfit(*both.T, 1))


def test_within_sets_is_a_regression_with_a_constant_for_each() -> None:
    """Where sets differ the other way than their searches, pooled and within have different signs."""
    sets = sets_of(0.7, 0.05, (0.0, 2.0, 4.0))
    both = np.concatenate([each.xy for each in sets])
    of_set = np.repeat(np.eye(3), 12, axis=0)
    coefficients = np.linalg.lstsq(np.column_stack([both[:, 0], of_set]), both[:, 1], rcond=None)[0]
    slope, intercept = line(sets, True)
    assert slope == pytest.approx(coefficients[0])
    assert intercept == pytest.approx(coefficients[1:].mean())
    left = [column - of_set @ (of_set.T @ column) / 12 for column in both.T]
    assert correlation(sets, True, False) == pytest.approx(pearsonr(*left).statistic)
    one = sets_of(0.7, 0.2, (0.5,))
    assert correlation(one, True, True) == pytest.approx(spearmanr(*one[0].xy.T).statistic)
    assert correlation(sets, True, False) > 0.9 > 0.0 > correlation(sets, False, False)


def test_the_bound_is_below_and_one_strange_set_lowers_it() -> None:
    sets = sets_of(0.7, 0.1, (0.0,) * 6)
    alike = lower_bound(sets, True, False)
    assert alike < correlation(sets, True, False)
    strange = [*sets[:-1], SetPoints("strange", 5, sets[-1].xy * [1.0, -1.0])]
    assert lower_bound(strange, True, False) < alike - 0.2
    # Sets that share searches are drawn together: of one group there is nothing to draw.
    together = [SetPoints(each.name, 0, each.xy) for each in strange]
    assert lower_bound(together, True, False) == pytest.approx(correlation(strange, True, False))


def test_a_search_counts_once_and_controls_do_not() -> None:
    names = sets_in(PUBLISHED)
    assert "gap_room" in names
    evidence = evidence_of("gap_room")
    found = points_of(evidence, 0)
    searches = {
        (cell.method, cell.seed, cell.attack_id)
        for cell in evidence.cells.values()
        if cell.method in ("gradient", "random_coarse", "random_levels", "random_pink")
    }
    assert 0 < len(found.xy) <= len(searches)
    assert len(np.unique(found.xy, axis=0)) == len(found.xy)
