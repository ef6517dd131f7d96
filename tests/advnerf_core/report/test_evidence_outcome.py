import dataclasses
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from advnerf_core.driving.metrics import Horizon, drive_metrics
from advnerf_core.driving.path import Path
from advnerf_core.report.evidence.outcome import Outcome, drive_outcome

FOUR = Horizon(ticks=4, dt_s=0.5, off_track_m=0.4)


def test_the_outcome_of_a_drive_by_hand():
    found = drive_outcome([0.1, -0.5, 0.3, -0.9], [0.1, 0.0, -0.1, 0.2], FOUR, collided_with="wall")
    assert found == Outcome(pytest.approx((1.8 - 0.4) / 4), True, "wall", 1.0, 0.5)


def test_a_drive_that_stays_on_its_track_never_leaves():
    # The limit itself is still on the track, as in the metrics of a drive.
    found = drive_outcome([0.4, -0.4, 0.0, 0.0], [0.5, 0.5, 0.5, 0.5], FOUR)
    assert found == Outcome(pytest.approx(0.2 - 0.5), False, None, None, 0.0)


def test_the_horizon_is_the_default_one_unless_given():
    assert drive_outcome(np.full(60, 0.2), np.zeros(60)).excess_cte_m_per_tick == pytest.approx(0.2)
    with pytest.raises(
        ValueError, match=r"attacked drive's CTE at 60 ticks \[60\], got shape \[4\]; fill in"
    ):
        drive_outcome(np.zeros(4), np.zeros(60))


def test_the_outcome_agrees_with_the_metrics_of_the_same_drive():
    path = Path.rounded_square(4.0, 1.1)
    x = np.linspace(-0.9, 0.9, 31)
    states = np.stack([x, -2.0 + 0.6 * (x + 0.9)], axis=1)
    horizon = Horizon(ticks=40)
    metrics = drive_metrics(path, states, horizon)
    found = drive_outcome(metrics.ctes_m, np.zeros(40), horizon)
    assert metrics.off_track
    assert found.off_track == metrics.off_track
    assert found.time_to_leaving_s == metrics.time_to_leaving_s
    assert found.excess_cte_m_per_tick == pytest.approx(metrics.mean_cte_m)


CTES = arrays(np.float64, 12, elements=st.floats(-3.0, 3.0))


@given(CTES, CTES)
def test_an_outcome_is_antisymmetric_in_its_excess_and_consistent_in_its_flags(attacked, none):
    horizon = Horizon(ticks=12)
    found, swapped = drive_outcome(attacked, none, horizon), drive_outcome(none, attacked, horizon)
    assert found.excess_cte_m_per_tick == -swapped.excess_cte_m_per_tick
    assert found.off_track == (found.share_off_lane > 0.0) == (found.time_to_leaving_s is not None)
    # The side of the path does not matter.
    assert drive_outcome(-attacked, none, horizon) == found


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0.1] * 4, [0.1] * 3, FOUR), r"none drive's CTE at 4 ticks \[4\], got shape \[3\]"),
        (([[0.1] * 4], [0.1] * 4, FOUR), r"attacked drive's CTE at 4 ticks \[4\], got shape \[1, 4\]"),
        (([0.1, np.nan, np.inf, 0.0], [0.1] * 4, FOUR), "finite CTE of the attacked drive, got 2 of 4"),
        (([0.1] * 4, [0.1] * 4, FOUR, ""), "name of what the car hit, got an empty one; pass None"),
    ],
)
def test_bad_drives_are_refused_with_what_to_do(arguments, message):
    with pytest.raises(ValueError, match=message):
        drive_outcome(*arguments)


def test_an_outcome_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        drive_outcome([0.0] * 4, [0.0] * 4, FOUR).off_track = True


def test_it_is_imported_without_torch():
    code = "import sys, advnerf_core.report.evidence.outcome; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stdout.strip()) == (0, "False"), done.stderr
