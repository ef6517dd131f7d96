"""Lines and arcs through poses, against the curves the poses were taken from."""

import math

import numpy as np
import pytest

from advnerf_core.driving.path import Arc, Line, Path
from hardware.worlds.fitting import advance, fit_lines_and_arcs


def as_path(start, segments):
    pieces = [Line(s[1]) if s[0] == "line" else Arc(s[1], s[2]) for s in segments]
    return Path.from_segments(tuple(start), pieces, closed=False)


def sampled(path, step_m=1.0):
    return path.pose_at(np.append(np.arange(0.0, path.length_m, step_m), path.length_m))


def test_a_straight_lane_is_one_line():
    poses = sampled(as_path((3.0, -2.0, 0.7), [("line", 40.0)]))
    assert fit_lines_and_arcs(poses.astype(np.float32)) == (("line", pytest.approx(40.0, abs=1e-4)),)


@pytest.mark.parametrize(
    "segments",
    [
        [("line", 14.0), ("arc", 8.25, -math.pi / 2), ("line", 40.0)],
        [("line", 5.3), ("arc", 11.75, math.pi / 2), ("line", 20.0), ("arc", 200.0, 0.2)],
        [("arc", 30.0, 0.5), ("arc", 30.0, -0.9), ("arc", 60.0, 0.4)],
    ],
)
def test_a_lane_of_lines_and_arcs_is_found_again(segments):
    truth = as_path((100.0, -50.0, 3.0), segments)
    poses = sampled(truth)
    poses[:, 2] = np.remainder(poses[:, 2], 2.0 * np.pi)  # as a map gives them
    found = fit_lines_and_arcs(poses.astype(np.float32), 0.02)
    fitted = as_path(poses[0], found)
    at = truth.project(fitted.pose_at(np.arange(0.0, fitted.length_m, 0.1))[:, :2])
    assert np.abs(at.cte_m).max() < 0.03
    assert fitted.length_m == pytest.approx(truth.length_m, abs=0.02)
    assert len(found) <= 2 * len(segments) + 4


def test_a_clothoid_is_followed_within_the_tolerance():
    """Curvature 0 to 1/20 over 40 m, integrated finely: no line or arc is exact."""
    s = np.arange(0.0, 40.0, 1e-3)
    yaw = s**2 / (2 * 40.0 * 20.0)
    xy = np.cumsum(np.stack([np.cos(yaw), np.sin(yaw)], 1) * 1e-3, axis=0)
    fitted = as_path((0.0, 0.0, 0.0), fit_lines_and_arcs(np.column_stack([xy, yaw])[::500], 0.01))
    assert np.abs(fitted.project(xy[:-500]).cte_m).max() < 0.015


def test_end_of_a_piece_in_closed_form():
    np.testing.assert_allclose(advance([1.0, 2.0, 0.0], ("arc", 3.0, math.pi / 2)), [4.0, 5.0, math.pi / 2])
    np.testing.assert_allclose(advance([1.0, 2.0, math.pi / 2], ("line", 3.0)), [1.0, 5.0, math.pi / 2])


@pytest.mark.parametrize(
    "poses",
    [
        [[0.0, 0.0, 0.0]],
        [[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]],
        [[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]],  # behind
        [[0.0, 0.0, 0.0], [1.0, 0.0, 3.1]],  # turned round
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 30.0, 0.0]],  # a gap beside
    ],
)
def test_poses_that_are_no_way_are_refused(poses):
    with pytest.raises(ValueError, match="expected"):
        fit_lines_and_arcs(poses)
