"""The metrics of a trial on the page are those of every other trial."""

import numpy as np
import pytest

from advnerf_core.driving.metrics import Horizon, drive_metrics
from advnerf_core.driving.path import Path
from nodes.operator_page.trial import DONE, RUNNING, WAITING, Seen, Trial

MS = 1_000_000
EPOCH_NS = 1_800_000_000_000_000_000  # poses have the time of day, the loop has another clock


def step(trial, armed, position_m, attack_id, ms, reason="", pose_ms=None):
    """A step at a time, with a pose of that time or of another."""
    pose = (EPOCH_NS + round((ms if pose_ms is None else pose_ms) * MS), *position_m)
    return trial.step(Seen(armed, EPOCH_NS + ms * MS, pose, attack_id, reason), ms * MS)


def armed_at(trial, position_m, ms=-20):
    """The car is armed 2 cm beside this position, where its drive begins."""
    x, y = position_m
    assert not step(trial, True, (x - 0.02, y), "", ms)
    assert trial.phase == WAITING


def test_it_samples_the_control_ticks_from_the_first_motion_on():
    path = Path.rounded_square(4.0, 1.0)
    trial = Trial(path, 0.4, ticks=20, dt_s=0.1)
    trial.start()
    assert not step(trial, False, (0.0, 0.0), "", 0)
    assert trial.phase == WAITING
    track = np.array([np.add(path.pose_at(0.008 * k)[:2], [0.0, 0.001 * k]) for k in range(211)])
    armed_at(trial, track[0], 4500)
    armed_at(trial, track[0], 4980)
    rng = np.random.default_rng(0)
    ended = []
    for ms in range(5000, 8000, 20):
        # The loop sees a pose some milliseconds late; its stamp says when it was true.
        pose_ms = 5000 if ms == 5000 else ms - float(rng.uniform(0.0, 9.0))
        at = [np.interp((pose_ms - 5000) / 10, np.arange(211), track[:, k]) for k in (0, 1)]
        ended.append(step(trial, True, at, "abc" if ms > 5500 else "", ms, pose_ms=pose_ms))
        if ended[-1]:
            break
        assert trial.phase == RUNNING
    assert trial.phase == DONE
    assert 7000 <= ms <= 7040
    expected = drive_metrics(path, track[::10], Horizon(ticks=20))
    # Between poses 20 ms apart the car goes straight on.
    assert trial.state()["total_cte_m"] == pytest.approx(expected.total_cte_m, abs=1e-4)
    assert trial.state()["ticks"] == 20
    assert trial.state()["attack_id"] == "abc"


def test_a_car_that_stops_is_charged_for_the_rest():
    path = Path.rounded_square(4.0, 1.0)
    trial = Trial(path, 0.4, ticks=10)
    trial.start()
    beside = tuple(np.add(path.pose_at(0.0)[:2], [0.0, 0.3]))
    armed_at(trial, beside)
    for ms in range(0, 500, 20):
        assert not step(trial, True, beside, "", ms)
    assert step(trial, False, beside, "", 500)
    assert trial.state()["total_cte_m"] == pytest.approx(
        10 * abs(float(path.project(np.array(beside)).cte_m)), rel=1e-6
    )


@pytest.mark.parametrize("gap_ms", [400, 700])
def test_poses_that_the_page_missed_are_no_result(gap_ms):
    """As in a bag, where a tick in a longer gap than half a second is an error."""
    trial = Trial(Path.rounded_square(4.0, 1.0), 0.4, ticks=20)
    trial.start()
    armed_at(trial, (0.0, -2.3))
    for ms in range(0, 2100, 20):
        pose_ms = 500 if 500 < ms < 500 + gap_ms else ms
        if step(trial, True, (0.0, -2.3), "", ms, pose_ms=pose_ms):
            break
    state = trial.state()
    assert (state["counts"], "total_cte_m" in state) == ((gap_ms == 400,) * 2)
    assert state["counts"] or state["stopped"].startswith("poses are missing: expected no gap")


def test_a_trial_in_which_several_attacks_were_shown_is_no_result():
    trial = Trial(Path.rounded_square(4.0, 1.0), 0.4, ticks=20)
    trial.start()
    armed_at(trial, (0.0, -2.3))
    for ms in range(0, 2100, 20):
        if step(trial, True, (0.0, -2.3), "aaaa" if ms < 900 else "" if ms < 1200 else "bbbb", ms):
            break
    state = trial.state()
    assert (state["attack_id"], state["counts"], "total_cte_m" in state) == ("aaaa bbbb", False, False)
    assert state["stopped"] == "several attacks were shown: aaaa, bbbb"


def test_poses_that_stop_do_not_keep_a_trial_running():
    trial = Trial(None, 0.4, ticks=10)
    trial.start()
    armed_at(trial, (0.0, 0.0))
    ended = [ms for ms in range(0, 3000, 20) if step(trial, True, (0.0, 0.0), "", ms, pose_ms=min(ms, 300))]
    assert ended == [2020]


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
        assert not step(trial, True, (0.0, -2.3), "", ms)
    assert step(trial, False, (0.0, -2.3), "", 250, reason)
    state = trial.state()
    assert (state["phase"], state["ticks"], state["stopped"], state["counts"]) == (DONE, 2, reason, counts)
    assert ("total_cte_m" in state) is counts


def test_a_safety_node_that_says_nothing_any_more_ended_the_trial():
    trial = Trial(Path.rounded_square(4.0, 1.0), 0.4, ticks=60)
    trial.start()
    armed_at(trial, (0.0, -2.3))
    for ms in range(0, 3000, 20):
        pose = (EPOCH_NS + ms * MS, 0.0, -2.3)
        if trial.step(Seen(True, EPOCH_NS + min(ms, 1000) * MS, pose), ms * MS):
            break
    state = trial.state()
    assert (ms, state["ticks"], state["counts"], "total_cte_m" in state) == (1520, 10, False, False)
    assert state["stopped"] == "no message from the safety node for 0.5 s"


@pytest.mark.parametrize(
    ("reason", "counts"), [("no pose of the car for 0.22 s", False), ("the button is not held", True)]
)
def test_a_fault_that_took_the_last_poses_is_no_result_though_it_disarmed_after_the_end(reason, counts):
    """As in a bag, where the last tick lies in the gap."""
    trial = Trial(Path.rounded_square(4.0, 1.0), 0.4, ticks=20)
    trial.start()
    armed_at(trial, (0.0, -2.3))
    for ms in range(0, 2010, 10):
        assert not step(trial, True, (0.0, -2.3), "", ms, pose_ms=min(ms, 1950))
    assert step(trial, False, (0.0, -2.3), "", 2060, reason, pose_ms=1950)
    assert (trial.state()["counts"], trial.state()["stopped"]) == (counts, "" if counts else reason)


def test_without_a_path_it_only_counts():
    trial = Trial(None, 0.4, ticks=3)
    trial.start()
    armed_at(trial, (0.0, 0.0))
    for ms in range(0, 400, 20):
        step(trial, True, (0.0, 0.0), "", ms)
    assert "total_cte_m" not in trial.state()
    assert trial.state()["phase"] == DONE


def test_a_car_that_is_disarmed_before_it_moves_begins_no_trial():
    """As in a bag, where such an arming is no drive; the next one begins at its own place."""
    trial = Trial(None, 0.4, ticks=3)
    trial.start()
    assert not step(trial, True, (0.0, 0.0), "", 0)
    assert not step(trial, False, (0.0, 0.0), "", 100, "no pose of the car for 0.21 s")
    assert not step(trial, True, (0.5, 0.0), "", 200)  # carried there
    assert trial.phase == WAITING
    assert not step(trial, True, (0.52, 0.0), "", 300)
    assert trial.phase == RUNNING
