"""The drives against lane centres in closed form, and configurations that make no sense."""

import itertools
import math

import numpy as np
import pytest
from pydantic import ValidationError

from advnerf_core.driving.path import Arc, Line, Path
from hardware.worlds.junction.config import DubinsConfig, IntersectionConfig, RoadConfig
from hardware.worlds.junction.ground import kerb_lines, markings
from hardware.worlds.junction.paths import EXITS

CONFIG = IntersectionConfig()
PATHS = CONFIG.paths()
ALONG_M = np.arange(0.0, 56.0, 0.5)


def poses(name, along=ALONG_M):
    return np.array([PATHS[name].pose_at(float(s)) for s in along])


def test_straight_runs_in_the_middle_of_the_eastbound_lane():
    x, y, yaw = poses("straight").T
    np.testing.assert_allclose(x, ALONG_M - 24.0, atol=1e-9)
    np.testing.assert_allclose(y, -1.75)
    np.testing.assert_allclose(yaw, 0.0)


def test_the_lanes_cover_the_asphalt_of_the_junction_and_no_pavement():
    """Within half a lane of the lanes' middles lies all that is driven through, crossing and rounded corners included."""
    along = np.arange(0.0, 48.0, 0.05)
    middles = np.concatenate([[lane.pose_at(float(s))[:2] for s in along] for lane in CONFIG.lanes()])
    points = np.random.default_rng(0).uniform(-16.0, 16.0, (4000, 2))
    near_m = np.array([np.hypot(*(middles - point).T).min() for point in points])
    on_road = np.array([CONFIG.on_road(*point) for point in points])
    assert near_m[~on_road].min() > CONFIG.off_track_m - 0.01
    # What lies farther from all of them is the middle of the crossing, far from any pavement.
    assert np.abs(points[on_road & (near_m > CONFIG.off_track_m + 0.01)]).max(initial=0.0) < 8.0


def test_a_mirrored_drive_is_the_drive_in_the_mirror():
    for name, reference in PATHS.items():
        for across, signs in (("x", (1.0, -1.0)), ("y", (-1.0, 1.0))):
            there = np.array([reference.mirrored(across).pose_at(float(s))[:2] for s in ALONG_M])
            np.testing.assert_allclose(there, poses(name)[:, :2] * signs, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "start", "centre", "radius", "turn", "end_yaw", "end_axis", "end_at"),
    [
        ("right", (-24.0, -1.75, 0.0), (-9.5, -9.5), 7.75, -1.0, -0.5 * math.pi, 0, -1.75),
        ("left", (1.75, -24.0, 0.5 * math.pi), (-7.0, -7.0), 8.75, 1.0, math.pi, 1, 1.75),
    ],
)
def test_turns_are_quarter_circles_from_lane_to_lane(
    name, start, centre, radius, turn, end_yaw, end_axis, end_at
):
    path = PATHS[name]
    assert path.start_pose == pytest.approx(start)
    first = path.segments[0][1]
    arc = poses(name, first + np.linspace(0.0, 0.5 * math.pi * radius, 40))
    np.testing.assert_allclose(np.hypot(*(arc[:, :2] - centre).T), radius, rtol=1e-12)
    outward = np.arctan2(*(arc[:, :2] - centre).T[::-1])
    np.testing.assert_allclose(np.sin(arc[:, 2] - outward - turn * 0.5 * math.pi), 0.0, atol=1e-9)
    after = poses(name, first + 0.5 * math.pi * radius + np.arange(0.0, 29.0, 1.0))
    np.testing.assert_allclose(after[:, end_axis], end_at, atol=1e-9)
    np.testing.assert_allclose(np.cos(after[:, 2] - end_yaw), 1.0)


@pytest.mark.parametrize("name", PATHS)
def test_poses_equal_those_of_the_reference_path_that_is_driven(name):
    path = PATHS[name]
    pieces = [Line(piece[1]) if piece[0] == "line" else Arc(piece[1], piece[2]) for piece in path.segments]
    driven = Path.from_segments(path.start_pose, pieces, closed=False)
    assert path.length_m == pytest.approx(driven.length_m)
    assert path.length_m >= 36.0 + 20.0
    ours, theirs = poses(name), driven.pose_at(ALONG_M)
    np.testing.assert_allclose(ours[:, :2], theirs[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.cos(ours[:, 2] - theirs[:, 2]), 1.0)


@pytest.mark.parametrize("name", PATHS)
def test_a_path_is_extended_straight_beyond_its_ends(name):
    path = PATHS[name]
    for s, beyond in ((0.0, -3.0), (path.length_m, 4.0)):
        x, y, yaw = path.pose_at(s)
        expected = (x + beyond * math.cos(yaw), y + beyond * math.sin(yaw), yaw)
        assert path.pose_at(s + beyond) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("name", PATHS)
def test_the_car_keeps_to_the_asphalt_on_its_path(name):
    for x, y, yaw in poses(name):
        for aside in (-0.9, 0.9):
            assert CONFIG.on_road(x - aside * math.sin(yaw), y + aside * math.cos(yaw))


def test_goals_name_the_exits():
    assert EXITS == ("east", "south", "west")
    assert {name: path.goal for name, path in PATHS.items()} == {
        "straight": (1.0, 0.0, 0.0),
        "right": (0.0, 1.0, 0.0),
        "left": (0.0, 0.0, 1.0),
    }


def test_the_kerb_is_where_the_asphalt_ends():
    for line in kerb_lines(CONFIG.road, 0.0).values():
        for a, b in itertools.pairwise(line):
            along = (b - a) / np.linalg.norm(b - a)
            middle, right = 0.5 * (a + b), np.array([along[1], -along[0]])
            # The chords of a corner lie 8 mm behind its arc.
            assert CONFIG.on_road(*(middle + 0.02 * right))
            assert not CONFIG.on_road(*(middle - 0.02 * right))


def test_markings_lie_on_the_asphalt_and_face_up():
    for piece in markings(CONFIG.road):
        assert all(CONFIG.on_road(x, y) for x, y in piece)
        (ax, ay), (bx, by), (cx, cy) = piece[:3]
        assert (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) > 0.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"car": DubinsConfig(speed_mps=12.0)}, "turns the car can follow"),
        ({"left_radius_m": 30.0}, "approach_m"),
        ({"approach_m": 55.0}, "approach_m"),
        ({"road": RoadConfig(corner_radius_m=3.0)}, "pavement narrower"),
        ({"speed": 6.0}, "Extra inputs"),
        ({"supersampling": 0}, "greater than or equal to 1"),
    ],
)
def test_bad_configurations_say_what_is_wrong(changes, message):
    with pytest.raises(ValidationError, match=message):
        IntersectionConfig(**changes)
