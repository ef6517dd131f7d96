import numpy as np
import pytest
from pydantic import ValidationError

from advnerf_core.driving.metrics import Horizon, drive_metrics
from advnerf_core.driving.path import Path
from advnerf_core.report.evidence.kept import KeptDrive, kept_drives

SQUARE = Path.rounded_square(4.0, 1.0)
HORIZON = Horizon(20, 0.1, 0.4)


def drive(ticks=20):
    states = SQUARE.pose_at(np.linspace(0.0, 3.0, ticks + 1))
    states[:, 1] += np.linspace(0.0, 0.7, ticks + 1)
    return states


@pytest.mark.parametrize("stopped", [20, 7])
def test_numbers_computed_from_what_is_kept_are_those_of_the_drive(stopped):
    states = drive()
    whole = drive_metrics(SQUARE, states, HORIZON, stopped)
    kept = KeptDrive.of(states, len(whole.ctes_m) - whole.held_ticks, np.linspace(-1, 1, 20))
    again = KeptDrive.model_validate_json(kept.model_dump_json()).metrics(SQUARE, HORIZON)
    assert again.total_cte_m == pytest.approx(whole.total_cte_m, abs=20 * 1e-5)
    assert (again.off_track, again.held_ticks) == (whole.off_track, whole.held_ticks)
    np.testing.assert_allclose(kept.poses(), states[:, :3], atol=5.1e-6)


def test_what_the_car_ran_into_is_kept():
    found = {"states": [drive(), drive(), drive()], "driven_ticks": [20, 9, 9], "commands": [[], [], []]}
    hits = {"blocked_tick": [None, 9, 9], "collided_with": [None, "wall", None]}
    kept = [KeptDrive.model_validate(each) for each in kept_drives({**found, **hits})]
    assert [each.obstacle for each in kept] == [None, "wall", "obstacle"]
    assert [KeptDrive.model_validate(each).obstacle for each in kept_drives(found)] == [None, None, None]


def test_a_drive_takes_a_few_kilobytes():
    assert len(KeptDrive.of(drive(), 20).model_dump_json()) < 1000


@pytest.mark.parametrize(
    "changed", [{"x_m": "1 2 nan"}, {"x_m": "1 two"}, {"driven_ticks": -1}, {"colour": 1}]
)
def test_what_is_no_drive_is_refused(changed):
    with pytest.raises(ValidationError):
        KeptDrive.model_validate({**KeptDrive.of(drive(), 20).model_dump(), **changed})
    with pytest.raises(ValueError, match="of one length"):
        KeptDrive(x_m="1 2", y_m="1", yaw_rad="1 2", driven_ticks=1).poses()


@pytest.mark.parametrize(
    "text", ["", "0", "-1.25 3", "12345678901 1", "1e-05 2", "1  2", "\t1 2\n", "-0.00000 1."]
)
def test_numbers_are_taken_as_they_are(text):
    kept = KeptDrive(x_m=text, y_m=text, yaw_rad=text, driven_ticks=0)
    assert kept.x_m == text
    np.testing.assert_array_equal(kept.poses()[:, 0], [float(each) for each in text.split()])


@pytest.mark.parametrize("text", ["nan", "1 inf", "1e400", "1-2", "1,2", "1 -", "1.2.3", "one"])
def test_what_is_no_finite_number_is_refused(text):
    with pytest.raises(ValueError, match="x_m"):
        KeptDrive(x_m=text, y_m="1", yaw_rad="1", driven_ticks=0)
