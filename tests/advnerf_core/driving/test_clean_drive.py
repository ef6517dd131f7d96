"""What counts as a drive, in metres."""

import json

import numpy as np
import pytest

from advnerf_core.driving.clean_drive import CleanDrive
from advnerf_core.driving.metrics import Horizon, drive_metrics, drives, mean_cte_limit_m
from advnerf_core.driving.path import Path

SQUARE = Path.rounded_square(4.0, 1.1)


def drive(*offsets_m, ticks=20, off_track_m=0.4):
    """Drives beside the path, each at its own distance."""
    horizon = Horizon(ticks, off_track_m=off_track_m)
    metrics = []
    for offset_m in offsets_m:
        poses = SQUARE.pose_at(0.02 * np.arange(ticks + 1))
        poses[:, 0] -= np.sin(poses[:, 2]) * offset_m
        poses[:, 1] += np.cos(poses[:, 2]) * offset_m
        metrics.append(drive_metrics(SQUARE, poses, horizon))
    return CleanDrive.of(metrics, horizon)


def test_the_rule_is_never_off_the_track_and_near_the_path_in_the_mean():
    assert mean_cte_limit_m() == pytest.approx(0.08)
    assert drives(0.08, False)
    assert not drives(0.081, False)
    assert not drives(0.01, True)
    assert drives(0.3, False, off_track_m=1.75)


def test_a_drive_is_told_in_metres_and_one_that_is_none_is_warned_about():
    good = drive(0.02, -0.05)
    assert good.drives
    assert good.warning == ""
    assert good.total_cte_m == pytest.approx((0.4, 1.0), abs=1e-6)
    assert good.mean_total_cte_m == pytest.approx(0.7)
    assert good.lines == [
        "drive without attack: total CTE 0.70 m over 20 ticks, mean |CTE| 0.035 m, at most 0.05 m"
    ]
    assert good.short == "without attack 0.70 m"
    wide = drive(0.02, 0.3)
    assert not wide.drives
    assert "its mean |CTE| is 0.160 m, expected <= 0.08 m" in wide.warning
    assert "leaves the track" not in wide.warning
    off = drive(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.45)  # a small mean hides one that left
    assert not off.drives
    assert "leaves the track (|CTE| > 0.4 m) from 1 of 7 starts" in off.warning
    assert off.short.endswith("(NO DRIVE)")
    assert drive(0.3, off_track_m=1.75).drives


def test_it_survives_a_file_and_refuses_what_is_none():
    found = drive(0.02, 0.5)
    assert CleanDrive.from_dict(json.loads(json.dumps(found.to_dict()))) == found
    with pytest.raises(ValueError, match="for every start"):
        CleanDrive((1.0,), (0.1, 0.2), (0.2,), (False,), 10, 0.4)
    with pytest.raises(ValueError, match="finite"):
        CleanDrive((float("nan"),), (0.1,), (0.2,), (False,), 10, 0.4)
