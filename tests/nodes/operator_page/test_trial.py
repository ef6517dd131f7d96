"""The metrics of a trial on the page are those of every other trial."""

import numpy as np
import pytest

from advnerf_core.driving.metrics import Horizon, drive_metrics
from advnerf_core.driving.path import Path
from nodes.operator_page.trial import DONE, RUNNING, WAITING, Trial

MS = 1_000_000


def armed_at(trial, position_m, ms=-20):
    """The car is armed 2 cm beside this position, where its drive begins."""
    x, y = position_m
    assert not trial.step(True, (x - 0.02, y), "", ms * MS)
    assert trial.phase == WAITING


def test_it_samples_the_control_ticks_from_the_first_motion_on():
    path = Path.rounded_square(4.0, 1.0)
    trial = Trial(path, 0.4, ticks=20, dt_s=0.1)
    trial.start()
    assert not trial.step(False, (0.0, 0.0), "", 0)
    assert trial.phase == WAITING
    track = [tuple(np.add(path.pose_at(0.08 * k)[:2], [0.0, 0.01 * k])) for k in range(21)]
    armed_at(trial, track[0], 4500)
    armed_at(trial, track[0], 4980)
    ended = []
    for ms in range(5000, 8000, 20):
        position = track[(ms - 5000) // 100]
        ended.append(trial.step(True, position, "abc" if ms > 5500 else "", ms * MS))
        if ended[-1]:
            break
        assert trial.phase == RUNNING
    assert trial.phase == DONE
    assert ms == 7000
    expected = drive_metrics(path, np.array(track), Horizon(ticks=20))
    assert trial.state()["total_cte_m"] == pytest.approx(expected.total_cte_m, abs=1e-6)
    assert trial.state()["ticks"] == 20
    assert trial.state()["attack_id"] == "abc"


def test_a_car_that_stops_is_charged_for_the_rest():
    path = Path.rounded_square(4.0, 1.0)
    trial = Trial(path, 0.4, ticks=10)
    trial.start()
    beside = tuple(np.add(path.pose_at(0.0)[:2], [0.0, 0.3]))
    armed_at(trial, beside)
    for ms in range(0, 500, 20):
        assert not trial.step(True, beside, "", ms * MS)
    assert trial.step(False, beside, "", 500 * MS)
    assert trial.state()["total_cte_m"] == pytest.approx(
        10 * abs(float(path.project(np.array(beside)).cte_m)), rel=1e-6
    )


@pytest.mark.parametrize(
    ("reason", "counts"),
    [
        ("no pose of the car for 0.21 s", False),
        ("the page has not answered for 0.31 s", False),
        ("node camera has been silent for 1.1 s", False),
        ("the car is outside the fence, at (3.60, 0.00) m", True),
        ("stalled for 1.0 s: commanded 0.80 m/s, the car does not move", True),
        ("disarmed by operator: on the page by Ann", True),
        ("the button is not held", True),
    ],
)
def test_a_trial_that_a_fault_of_the_stack_ended_is_no_result(reason, counts):
    trial = Trial(Path.rounded_square(4.0, 1.0), 0.4, ticks=60)
    trial.start()
    armed_at(trial, (0.0, -2.3))
    for ms in range(0, 250, 20):
        assert not trial.step(True, (0.0, -2.3), "", ms * MS)
    assert trial.step(False, (0.0, -2.3), "", 250 * MS, reason)
    state = trial.state()
    assert (state["phase"], state["ticks"], state["stopped"], state["counts"]) == (DONE, 2, reason, counts)
    assert ("total_cte_m" in state) is counts


def test_without_a_path_it_only_counts():
    trial = Trial(None, 0.4, ticks=3)
    trial.start()
    armed_at(trial, (0.0, 0.0))
    for ms in range(0, 400, 20):
        trial.step(True, (0.0, 0.0), "", ms * MS)
    assert "total_cte_m" not in trial.state()
    assert trial.state()["phase"] == DONE


def test_a_car_that_is_disarmed_before_it_moves_begins_no_trial():
    """As in a bag, where such an arming is no drive; the next one begins at its own place."""
    trial = Trial(None, 0.4, ticks=3)
    trial.start()
    assert not trial.step(True, (0.0, 0.0), "", 0)
    assert not trial.step(False, (0.0, 0.0), "", 100 * MS, "no pose of the car for 0.21 s")
    assert not trial.step(True, (0.5, 0.0), "", 200 * MS)  # carried there
    assert trial.phase == WAITING
    assert not trial.step(True, (0.52, 0.0), "", 300 * MS)
    assert trial.phase == RUNNING
