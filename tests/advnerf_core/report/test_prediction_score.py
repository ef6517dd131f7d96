"""Scores of predicted bands, against sums by hand."""

import numpy as np
import pytest

from advnerf_core.report.cells import read_cells
from advnerf_core.report.evidence.prediction_score import interval_score, past_differences, score_cells
from advnerf_core.report.evidence.registration import read_registration
from advnerf_core.report.evidence.results import Evidence
from benchmarks.planted_changes import write_simulated_set


@pytest.fixture(scope="module")
def evidence(tmp_path_factory: pytest.TempPathFactory) -> Evidence:
    folder = tmp_path_factory.mktemp("published") / "simulated"
    write_simulated_set(folder)
    registration = read_registration(folder)
    assert registration is not None
    return Evidence(registration, read_cells(folder))


def test_the_interval_score_is_that_of_the_paper() -> None:
    # Width 2; one below by 1 costs 2 / 0.2 more, one above by 0.5 half of that.
    assert interval_score(1.0, 3.0, [2.0, 0.0, 3.5]) == pytest.approx([2.0, 12.0, 7.0])
    # It is proper: of a normal value the true quantiles score best.
    values = np.random.default_rng(0).normal(size=20_000)
    best = interval_score(-1.2816, 1.2816, values).mean()
    assert best < interval_score(-0.9, 0.9, values).mean()
    assert best < interval_score(-1.8, 1.8, values).mean()


def test_drives_are_scored_in_half_lanes(evidence: Evidence) -> None:
    name = "track_hardened_gradient_0"
    cell = evidence.cells[name]
    half_lane_m = evidence.scenario_of(cell).off_track_m
    learned, deployed = (
        [outcome.excess_cte_m_per_tick / half_lane_m for outcome in evidence.outcomes(cell, domain)]
        for domain in ("surrogate", "deployed")
    )
    low, high = np.quantile(deployed, (0.2, 0.7))
    said = {"excess_low_m": low * half_lane_m, "excess_high_m": high * half_lane_m}
    unknown = {name: said, "track_hardened_none_0": said, "not_there": said}
    (found,) = score_cells(evidence, unknown, [evidence])
    assert found.measured == pytest.approx(tuple(deployed))
    assert found.held == sum(low <= value <= high for value in deployed)
    assert found.score == pytest.approx(interval_score(low, high, deployed).mean())
    differences = past_differences([evidence])
    assert len(differences) == 2 * 2 * 6 * 5  # two conditions, two methods of six searches from five starts
    pairs = [one + other for one in learned for other in differences]
    assert found.trivial_band == pytest.approx(tuple(np.quantile(pairs, (0.1, 0.9))))


def test_a_past_without_attacks_is_refused(evidence: Evidence) -> None:
    none = [cell for cell in evidence.cells.values() if cell.method == "none"]
    with pytest.raises(ValueError, match="name a published set"):
        score_cells(evidence, {}, [Evidence(evidence.registration, none)])
