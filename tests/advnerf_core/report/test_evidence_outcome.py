import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from advnerf_core.driving.metrics import Horizon, drive_metrics
from advnerf_core.driving.path import Line, Path
from advnerf_core.report.evidence.rows import Outcome

STRAIGHT = Path.from_segments((0.0, 0.0, 0.0), [Line(20.0)], closed=False)
FOUR = Horizon(ticks=4, dt_s=0.5, off_track_m=0.4)


def outcome(attacked_m, control_m, horizon=FOUR, hit=None):
    """Of drives along a straight path with these deviations at the ticks after the start."""
    drives = [
        drive_metrics(STRAIGHT, [(float(tick), cte) for tick, cte in enumerate([0.0, *ctes])], horizon)
        for ctes in (attacked_m, control_m)
    ]
    return Outcome.of(*drives, horizon, hit)


def test_the_outcome_of_a_drive_by_hand():
    found = outcome([0.1, -0.5, 0.3, -0.9], [0.1, 0.0, -0.1, 0.2], hit="wall")
    assert found == Outcome(pytest.approx((1.8 - 0.4) / 4), True, "wall", 1.0, 0.5)


def test_a_drive_that_stays_on_its_track_never_leaves():
    # The limit itself is still on the track, as in the metrics of a drive.
    found = outcome([0.4, -0.4, 0.0, 0.0], [0.5, 0.5, 0.5, 0.5])
    assert found == Outcome(pytest.approx(0.2 - 0.5), False, None, None, 0.0)


CTES = arrays(np.float64, 12, elements=st.floats(-3.0, 3.0))


@given(CTES, CTES)
def test_an_outcome_is_antisymmetric_in_its_excess_and_consistent_in_its_flags(attacked, control):
    horizon = Horizon(ticks=12)
    found, swapped = outcome(attacked, control, horizon), outcome(control, attacked, horizon)
    assert found.excess_cte_m_per_tick == -swapped.excess_cte_m_per_tick
    assert found.off_track == (found.share_off_lane > 0.0) == (found.time_to_leaving_s is not None)
    # The side of the path does not matter.
    assert outcome(-attacked, control, horizon) == found


def test_it_is_imported_without_torch():
    code = "import sys, advnerf_core.report.evidence.rows; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stdout.strip()) == (0, "False"), done.stderr
