import numpy as np
import pytest

from advnerf_core.attack.artifact import face_texture
from advnerf_core.driving.path import Arc, Line, Path
from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import make_transform, planar_pose, rotation_x, rotation_z, transform_points
from calibration.degeneracy import DegenerateDataError
from calibration.placement import face_frame, measured_pose, misplacement, require_same_corners
from calibration.room import (
    clearance,
    fence_around,
    fence_from_trace,
    find_touches,
    start_before_corner,
    target_of_size,
    target_of_touches,
)
from calibration.schema import CalibrationError
from tests.support.faces import face_attack, outward_normal, reordered

SQUARE = Path.rounded_square(4.0, 1.1)


def area(polygon):
    x, y = np.array(polygon).T
    return 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


@pytest.mark.parametrize(
    ("size_m", "centre_m", "subject", "message"),
    [
        ((59.77, 33.62), (0, 0, 0), "monitor", "is it in cm or mm"),
        ((0.6, np.inf), (0, 0, 0), "monitor", "finite numbers"),
        ((0.6, 0.3), (0, np.nan, 0), "monitor", "finite numbers"),
        ((0.6, 0.3), (0, 0, 0), "", "subject"),
        (
            (0.6, 0.3),
            (20, 0, 100),
            "monitor",
            "within 20 m of its subject's origin, got 102.0 m; is a length, .* in cm or mm",
        ),
    ],
)
def test_a_face_that_cannot_be_is_an_error_of_ours(size_m, centre_m, subject, message):
    with pytest.raises(AdvnerfError, match=message):
        target_of_size(subject, size_m, centre_m, 0.0, "ruler")


def walk(corners, noise_m=0.003):
    pieces = [
        np.linspace(a, b, 300, endpoint=False)
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    trace = np.concatenate(pieces)
    return trace + np.random.default_rng(0).normal(0.0, noise_m, trace.shape)


def test_a_walked_fence_lies_a_margin_inside():
    corners = np.array([[-3.8, -3.8], [3.8, -3.8], [3.8, 3.8], [-3.8, 3.8]])
    fence = fence_from_trace(walk(corners), 0.3)
    assert area(fence) == pytest.approx(7.0**2, rel=0.02)
    assert np.abs(np.array(fence)).max() == pytest.approx(3.5, abs=0.03)
    assert clearance(SQUARE, fence) == pytest.approx(1.5, abs=0.03)
    # A second lap changes next to nothing, where it had emptied the first.
    twice = fence_from_trace(walk(np.concatenate([corners, 1.005 * corners])), 0.3)
    assert area(twice) == pytest.approx(7.0**2, rel=0.02)
    # A room that is not convex keeps its notch.
    notched = np.array([[-3, -3], [3, -3], [3, 0], [0, 0], [0, 3], [-3, 3]], float)
    assert area(fence_from_trace(walk(notched), 0.0)) == pytest.approx(27.0, rel=0.02)
    assert clearance(SQUARE, fence_from_trace(walk(notched), 0.0)) < 0.0


def test_a_fence_around_a_path_and_what_is_no_fence():
    fence = fence_around(SQUARE, 0.8)
    assert clearance(SQUARE, fence) == pytest.approx(0.8, abs=0.03)
    track_m2 = 16.0 - (4.0 - np.pi) * 1.1**2
    assert area(fence) == pytest.approx(track_m2 + 0.8 * SQUARE.length_m + np.pi * 0.8**2, rel=0.02)
    with pytest.raises(DegenerateDataError, match="no floor is left"):
        fence_from_trace(walk(np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.5]])), 0.4)
    with pytest.raises(DegenerateDataError, match="at most 50 m"):
        fence_from_trace(walk(40.0 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])), 0.1)


def test_a_walk_whose_way_was_not_seen_is_no_fence():
    """Behind the corner of an L the wand was hidden: the straight line across it goes through the wall."""
    notched = walk(np.array([[-3, -3], [3, -3], [3, 0], [0, 0], [0, 3], [-3, 3]], float))
    around = np.linalg.norm(notched, axis=1)
    hidden = notched[~((around < 2.0) & (notched > -0.1).all(axis=1))]
    with pytest.raises(
        DegenerateDataError, match=r"1 jumps of up to 2\.8\d m, the largest at \(.*was the subject hidden"
    ):
        fence_from_trace(hidden, 0.3)
    spiked = notched.copy()
    spiked[100:150] = [-6.0, 2.0]
    with pytest.raises(DegenerateDataError, match=r"2 jumps of up to .* mistaken for another"):
        fence_from_trace(spiked, 0.3)
    with pytest.raises(
        DegenerateDataError, match=r"ends within 0\.5 m of its start, got 6\.0\d m: walk around all"
    ):
        fence_from_trace(notched[:-300], 0.3)


def test_a_straight_path_has_no_corner_to_start_before():
    with pytest.raises(DegenerateDataError, match=r"path with corners, .* got a straight one"):
        start_before_corner(Path((0.0, 0.0, 0.0), [Line(4.0)], closed=False), 1, 1.0)


def test_the_start_is_so_far_before_the_corner():
    # The bottom straight ends at x = 0.9, where the first corner begins.
    assert start_before_corner(SQUARE, 1, 1.5) == pytest.approx((-0.6, -2.0, 0.0), abs=1e-4)
    x, y, yaw = start_before_corner(SQUARE, 1, 1.8 + 1.1 * np.pi / 2)  # back over the corner behind it
    assert (x, y) == pytest.approx((-2.0, -0.9), abs=1e-4)
    assert np.cos(yaw + np.pi / 2) == pytest.approx(1.0, abs=1e-6)
    with pytest.raises(DegenerateDataError, match="corner from 1 to 4"):
        start_before_corner(SQUARE, 5, 1.0)
    opened = Path.from_segments((0.0, 0.0, 0.0), [Line(1.0), Arc(1.0, 1.0)], closed=False)
    with pytest.raises(DegenerateDataError, match=r"there are 1\.00 m"):
        start_before_corner(opened, 1, 2.0)


def test_a_target_by_ruler_has_its_corners_where_the_viewer_sees_them():
    target = target_of_size("board", (1.0, 0.8), (0.1, 0.0, 0.0), 0.0, "ruler")
    # Facing the board one looks along -x: left is -y.
    np.testing.assert_allclose(target.corners[0], [0.1, -0.5, 0.4])
    np.testing.assert_allclose(outward_normal(target), [1.0, 0.0, 0.0], atol=1e-12)
    turned = target_of_size("board", (1.0, 0.8), (0.0, 0.0, 0.0), np.pi / 2, "ruler")
    np.testing.assert_allclose(outward_normal(turned), [0.0, 1.0, 0.0], atol=1e-12)
    with pytest.raises(DegenerateDataError, match="width and a height > 0"):
        target_of_size("board", (1.0, 0.0), (0.0, 0.0, 0.0), 0.0, "ruler")


TRUE_CORNERS = np.array(
    [[0.02, -0.299, 0.31], [0.02, 0.299, 0.31], [0.02, 0.299, -0.026], [0.02, -0.299, -0.026]]
)


def touch(order=(0, 1, 2, 3), noise_m=0.0005, tip=(0.0, 0.02, -0.35)):
    """A wand, held differently each time, rests at the corners for a second, and travels in between."""
    rng = np.random.default_rng(4)
    T_world_from_subject = make_transform(rotation_z(2.5), [1.0, 3.0, 0.5])
    corners = transform_points(T_world_from_subject, TRUE_CORNERS)
    away, stops = np.array([0.0, 2.0, 1.0]), []
    for index in order:
        stops += [
            (away, corners[index], 80),
            (corners[index], corners[index], 110),
            (corners[index], away, 80),
        ]
    places = np.concatenate([np.linspace(a, b, count) for a, b, count in stops])
    wands = []
    for k, place in enumerate(places):
        rotation = rotation_z(0.3 * np.sin(k / 300.0)) @ np.array(
            [[1, 0, 0], [0, 0.96, -0.28], [0, 0.28, 0.96]]
        )
        wands.append(make_transform(rotation, place - rotation @ np.array(tip) + rng.normal(0.0, noise_m, 3)))
    stamps = np.arange(len(places), dtype=np.int64) * 10_000_000
    return find_touches(
        stamps, np.array(wands), np.repeat(T_world_from_subject[None], len(places), axis=0), tip
    )


def test_a_wand_finds_the_corners_of_a_panel():
    target = target_of_touches("monitor", touch())
    np.testing.assert_allclose(target.corners, TRUE_CORNERS, atol=0.001)
    assert target.residuals["rectangle_mm"] < 1.0
    np.testing.assert_allclose(outward_normal(target), [1.0, 0.0, 0.0], atol=0.01)


def test_wrong_touches_are_refused_with_what_to_do():
    with pytest.raises(DegenerateDataError, match="found 3 rests"):
        target_of_touches("monitor", touch((0, 1, 2)))
    with pytest.raises(DegenerateDataError, match="order"):
        target_of_touches("monitor", touch((0, 2, 1, 3)))


@pytest.mark.parametrize(
    ("order", "got"),
    [
        ((1, 0, 3, 2), "a wand that came from behind it"),  # mirrored
        ((1, 2, 3, 0), "its top beside or below its bottom"),
        ((2, 3, 0, 1), "its top beside or below its bottom"),
        ((3, 2, 1, 0), "its top beside or below its bottom"),  # upside down, and mirrored
        ((0, 3, 2, 1), "its top beside or below its bottom"),
    ],
)
def test_corners_in_another_order_are_refused(order, got):
    """Each is a rectangle; the attack would be shown mirrored or turned."""
    with pytest.raises(DegenerateDataError, match=f"top left, .* as seen from the front, got {got}"):
        target_of_touches("monitor", touch(order))


def attack(T, size=1.0, subject="board"):
    theta = np.zeros((4, 4, 3), np.float32)
    return face_attack(
        method="random",
        theta=theta,
        texture=face_texture(theta, 8),
        size_m=(size, size),
        T_world_from_object=T,
        subject=subject,
        corners_in_subject=BOARD.corners,
    )


BOARD = target_of_size("board", (1.0, 1.0), (0.03, 0.0, 0.2), 0.0, "ruler")
T_FACE = make_transform(rotation_z(np.deg2rad(188.0)), [3.04, -1.80, 0.52])


def subject_for(T_world_from_face):
    """Where the subject is when its face is there."""
    return T_world_from_face @ np.linalg.inv(face_frame(BOARD.corners))


def test_a_face_in_its_place_is_in_its_place():
    off = misplacement(attack(T_FACE), BOARD, subject_for(T_FACE))
    assert off.distance_m < 1e-9
    assert off.within(1e-6, 1e-6)


@pytest.mark.parametrize(
    ("moved", "turned", "name", "expected", "text"),
    [
        ((0.0, 0.05, 0.0), np.eye(3), "right_m", 0.05, "5.0 cm left"),
        ((0.0, 0.0, -0.03), np.eye(3), "up_m", -0.03, "3.0 cm up"),
        ((0.04, 0.0, 0.0), np.eye(3), "near_m", 0.04, "4.0 cm away from you"),
        ((0.0, 0.0, 0.0), rotation_z(0.1), "turned_rad", 0.1, "5.7 deg clockwise from above"),
        (
            (0.0, 0.0, 0.0),
            np.array([[np.cos(0.1), 0, -np.sin(0.1)], [0, 1, 0], [np.sin(0.1), 0, np.cos(0.1)]]),
            "tilted_rad",
            0.1,
            "5.7 deg top towards you",
        ),
        (
            (0.0, 0.0, 0.0),
            np.array([[1, 0, 0], [0, np.cos(0.1), np.sin(0.1)], [0, -np.sin(0.1), np.cos(0.1)]]),
            "rolled_rad",
            0.1,
            "5.7 deg counter-clockwise",
        ),
    ],
)
def test_each_direction_is_named_as_the_viewer_sees_it(moved, turned, name, expected, text):
    off = misplacement(attack(T_FACE), BOARD, subject_for(T_FACE @ make_transform(turned, moved)))
    assert getattr(off, name) == pytest.approx(expected, abs=1e-9)
    others = {"right_m", "up_m", "near_m", "turned_rad", "tilted_rad", "rolled_rad"} - {name}
    assert all(abs(getattr(off, other)) < 1e-9 for other in others)
    assert text in [advice for _, advice in off.advice()]
    assert not off.within(0.02, 0.035)


def test_the_measured_pose_is_what_a_request_needs():
    pose = measured_pose(BOARD, subject_for(planar_pose(1.0, 2.0, 0.5)))
    assert pose == pytest.approx({"x_m": 1.0, "y_m": 2.0, "z_m": 0.0, "yaw_rad": 0.5}, abs=1e-4)


def test_an_attack_for_something_else_is_refused():
    with pytest.raises(CalibrationError, match="is for monitor, the target is board"):
        misplacement(attack(T_FACE, subject="monitor"), BOARD, np.eye(4))


@pytest.mark.parametrize(
    ("order", "got"),
    [
        ((1, 2, 3, 0), "on its side: they begin 1 corner later, at the top right one"),
        ((2, 3, 0, 1), "upside down: they begin 2 corners later, at the bottom right one"),
        ((3, 0, 1, 2), "on its side: they begin 3 corners later, at the bottom left one"),
        ((1, 0, 3, 2), "mirrored: they go the other way round"),
        ((3, 2, 1, 0), "mirrored: they go the other way round"),
        ((0, 3, 2, 1), "mirrored: they go the other way round"),
    ],
)
def test_corners_in_another_order_than_the_attack_has_are_refused(order, got):
    made = attack(T_FACE)
    crooked = rotation_x(np.deg2rad(2.0))  # as a wand may measure it
    touched = BOARD.model_copy(update={"corners_in_subject_m": tuple(map(tuple, BOARD.corners @ crooked))})
    require_same_corners(made, touched)
    with pytest.raises(CalibrationError, match=f"of target board in the order top left, .*, got .*{got}; "):
        require_same_corners(made, reordered(touched, order))


def test_corners_of_a_redefined_subject_are_accepted_if_they_may_be_right():
    """Its origin and axes are free; a turn about the face's own middle and normal cannot be told from another order."""
    made = attack(T_FACE)
    for T in (
        make_transform(np.eye(3), [0.0, 0.4, -0.3]),  # the origin at another marker
        make_transform(rotation_x(np.pi), [0.0, 0.4, -0.3]),
        make_transform(rotation_z(np.pi / 2), [0.03, 0.0, 0.2])
        @ make_transform(np.eye(3), [-0.03, 0.0, -0.2]),
    ):
        rows = tuple(map(tuple, transform_points(T, BOARD.corners)))
        require_same_corners(made, BOARD.model_copy(update={"corners_in_subject_m": rows}))
    middle = BOARD.corners.mean(axis=0)
    turned = middle + (BOARD.corners - middle) @ rotation_x(np.deg2rad(-30.0)).T
    with pytest.raises(CalibrationError, match="got a face turned by 30 degrees in its plane; correct"):
        require_same_corners(
            made, BOARD.model_copy(update={"corners_in_subject_m": tuple(map(tuple, turned))})
        )
