"""The factor between surrogate and deployed excess, predicted from earlier sets whose truth is known."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from advnerf_core.report.evidence.results import Evidence, read_evidence
from advnerf_core.report.predictions import LEVEL, score_bands
from benchmarks.planted_changes import write_simulated_set
from benchmarks.transfer_factor import (
    PRIOR_SPREAD,
    Transfer,
    belief,
    binomial_interval,
    earlier_than,
    registered_bands,
    rival_bands,
    transfer_of,
)

ENDS = np.array([0.1, 0.9])


@pytest.fixture(scope="module")
def evidence(tmp_path_factory):
    folder = tmp_path_factory.mktemp("published") / "simulated"
    write_simulated_set(folder)
    return read_evidence(folder)


def simulated(rng, centre=-0.223, spread=0.2, residual=0.1, searches=2, starts=3):
    """A set whose log factor is N(centre, spread^2); log 0.8 is -0.223."""
    surrogate = rng.uniform(0.5, 1.5, (searches, starts)) * rng.uniform(0.1, 1.0)
    factor = np.exp(centre + spread * rng.standard_normal())
    noise = residual * surrogate.mean() * rng.standard_normal(surrogate.shape)
    return Transfer("set", ("cell",) * searches, surrogate, factor * surrogate + noise)


@pytest.mark.parametrize("known", [0, 2, 6])
def test_bands_of_the_factor_hold_four_of_five_sets_of_the_prior(known):
    rng = np.random.default_rng(known)
    inside = []
    for _ in range(1500):
        # A draw of the prior: one degree of freedom for the spread, one set for the centre.
        spread = PRIOR_SPREAD / abs(rng.standard_normal())
        centre = spread * rng.standard_normal()
        if spread > 3.0 or abs(centre) > 3.0:  # factors beyond the least one
            continue
        *earlier, now = (simulated(rng, centre, spread, residual=0.0) for _ in range(known + 1))
        low, high = belief(earlier).factor_quantiles(ENDS)
        inside.append(low <= now.factor <= high)
    # 1,300 sets: 1.1 points of chance; the draws that are left out are the widest.
    assert 0.77 <= np.mean(inside) <= 0.9


@pytest.mark.parametrize("known", [2, 6])
def test_drives_are_held_and_few_sets_score_better_than_the_rival(known):
    rng = np.random.default_rng(known)
    drives, ours, rival = [], [], []
    for _ in range(250):
        *earlier, now = (simulated(rng, spread=0.4) for _ in range(known + 1))
        score = score_bands(belief(earlier).bands(now.surrogate, now.scale, LEVEL), now.deployed)
        drives.append(score.held / score.drives)
        ours.append(score.score)
        rival.append(score_bands(rival_bands(earlier, now.surrogate, LEVEL), now.deployed).score)
    assert 0.77 <= np.mean(drives) <= 0.93
    # The rival does not know how little a few sets say.
    assert np.mean(ours) <= (0.9 if known == 2 else 1.05) * np.mean(rival)


def test_with_many_sets_the_band_is_that_of_the_population():
    rng = np.random.default_rng(1)
    known = belief([simulated(rng, residual=0.01) for _ in range(2000)])
    low, high = known.factor_quantiles(ENDS)
    assert (low, high) == pytest.approx(tuple(0.8 * np.exp(0.2 * stats.norm.ppf(ENDS))), rel=0.03)


def test_without_an_earlier_set_the_prior_says_as_in_the_surrogate():
    known = belief([])
    assert known.factor_quantiles(np.array([0.5]))[0] == pytest.approx(1.0)
    low, high = known.factor_quantiles(ENDS)
    assert low < 0.5
    assert high > 2.0
    # One set moves the centre half of the way, in logarithms.
    one = Transfer("one", ("a",), np.array([[1.0, 2.0]]), np.array([[0.25, 0.5]]))
    assert belief([one]).factor_quantiles(np.array([0.5]))[0] == pytest.approx(0.5)


def test_bands_are_those_of_drawn_factors_and_residuals():
    rng = np.random.default_rng(2)
    known = belief([simulated(rng) for _ in range(3)])
    factors = np.exp(known.location + known.scale * rng.standard_t(known.freedom, 400_000))
    drawn = factors * 0.7 + 0.5 * rng.choice(known.residuals, 400_000)
    found = known.bands(np.array([0.7]), 0.5, LEVEL)[0]
    assert tuple(found) == pytest.approx(tuple(np.quantile(drawn, ENDS)), abs=0.02)


def test_the_factor_is_least_squares_through_the_origin():
    found = simulated(np.random.default_rng(3), searches=4, starts=6)
    expected = np.linalg.lstsq(found.surrogate.ravel()[:, None], found.deployed.ravel(), rcond=None)[0][0]
    assert found.factor == pytest.approx(expected)
    assert np.mean(found.factors) == pytest.approx(expected, rel=0.1)
    exact = dataclasses.replace(found, deployed=0.5 * found.surrogate)
    assert exact.factors == pytest.approx([0.5] * 4)
    assert exact.residuals(0.5) == pytest.approx(np.zeros(24))


def test_the_rival_multiplies_by_the_ratios_of_earlier_drives():
    one = Transfer("one", ("a",), np.ones((1, 11)), np.linspace(0.0, 1.0, 11)[None])
    assert rival_bands([one], np.array([2.0, -1.0]), 0.8) == pytest.approx(
        np.array([[0.2, 1.8], [-0.9, -0.1]])
    )
    with pytest.raises(ValueError, match="at least one earlier set"):
        rival_bands([], np.ones(3), 0.8)


def test_drives_are_in_half_lanes_of_the_last_test_that_was_run(evidence):
    found = transfer_of(evidence)
    cell = evidence.cells[found.cells[2]]
    half_lane_m = evidence.scenario_of(cell).off_track_m
    for domain, values in (("surrogate", found.surrogate), ("deployed", found.deployed)):
        expected = [each.excess_cte_m_per_tick / half_lane_m for each in evidence.outcomes(cell, domain)]
        assert values[2] == pytest.approx(expected)
    assert all("gradient" in name for name in found.cells)
    assert all("random" in name for name in transfer_of(evidence, baseline=True).cells)
    empty = Evidence(evidence.registration, [])
    assert transfer_of(empty) is None


def test_a_set_knows_only_sets_that_were_finished_before_its_first_cell(evidence):
    def on(day, cells):
        registration = evidence.registration.model_copy(update={"date": f"2026-01-{day:02d}T00:00:00+00:00"})
        made = [
            cell.model_copy(update={"date": f"2026-01-{each:02d}T12:00:00+00:00"})
            for cell, each in zip(evidence.cells.values(), cells, strict=False)
        ]
        other = Evidence(evidence.registration, made)
        other.registration = registration
        return other

    now = on(10, (12, 13))
    done, overlapping, later = on(5, (6, 11)), on(4, (6, 13)), on(11, (11, 11))
    oldest = on(1, (2, 3))
    assert earlier_than(now, [later, done, now, overlapping, oldest]) == [oldest, done]


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
