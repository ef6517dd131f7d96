import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from advnerf_core import geometry as g

angles = st.floats(-10.0, 10.0)
seeds = st.integers(0, 2**32 - 1)


def random_pose(seed):
    rng = np.random.default_rng(seed)
    return g.make_transform(Rotation.random(random_state=seed % 2**31).as_matrix(), rng.normal(size=3))


@given(seeds)
def test_quaternions_agree_with_scipy_and_come_back(seed):
    R = Rotation.random(random_state=seed % 2**31).as_matrix()
    q, reference = g.quaternion_from_rotation(R), Rotation.from_matrix(R).as_quat(canonical=True)
    assert min(np.abs(q - reference).max(), np.abs(q + reference).max()) < 1e-9
    np.testing.assert_allclose(g.rotation_from_quaternion(q), R, atol=1e-12)


@pytest.mark.parametrize("axis", np.eye(3))
def test_quaternion_of_half_turns(axis):
    R = Rotation.from_rotvec(np.pi * axis).as_matrix()
    np.testing.assert_allclose(g.rotation_from_quaternion(g.quaternion_from_rotation(R)), R, atol=1e-12)


@given(seeds, seeds, st.floats(0.0, 1.0))
def test_interpolation_is_slerp_and_lerp(seed_a, seed_b, fraction):
    a, b = random_pose(seed_a), random_pose(seed_b)
    T = g.interpolate_transform(a, b, fraction)
    slerp = Slerp([0, 1], Rotation.from_matrix(np.stack([a[:3, :3], b[:3, :3]])))
    np.testing.assert_allclose(T[:3, :3], slerp([fraction]).as_matrix()[0], atol=1e-6)
    np.testing.assert_allclose(T[:3, 3], (1 - fraction) * a[:3, 3] + fraction * b[:3, 3], atol=1e-12)


@given(seeds)
def test_inverse(seed):
    T = random_pose(seed)
    np.testing.assert_allclose(g.invert_transform(T), np.linalg.inv(T), atol=1e-12)


@given(angles)
def test_wrap_angle_keeps_the_direction(angle):
    wrapped = g.wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi
    np.testing.assert_allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(angle), np.sin(angle)], atol=1e-9)


def test_planar_poses_match_the_single_one():
    states = np.array([[1.0, 2.0, 0.3], [-1.0, 0.5, 3.0]])
    for state, T in zip(states, g.planar_poses(states), strict=True):
        np.testing.assert_allclose(T, g.planar_pose(*state))


def test_a_camera_on_a_car_sees_ahead_left_and_down_where_it_should():
    T_car_from_camera = g.camera_mount(0.3, 0.0, 0.2, pitch_down_rad=np.deg2rad(10))
    camera = g.Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0)
    T_camera_from_car = g.invert_transform(T_car_from_camera)
    ahead = 0.3 + 0.2 / np.tan(np.deg2rad(10))  # where the optical axis meets the floor
    np.testing.assert_allclose(
        camera.project(g.transform_points(T_camera_from_car, [ahead, 0, 0])), [168, 94], atol=1e-9
    )
    left_u, _ = camera.project(g.transform_points(T_camera_from_car, [2.0, 0.5, 0.0]))
    assert left_u < 168


def test_look_at_puts_the_target_on_the_axis_and_keeps_the_camera_upright():
    T = g.look_at([1.0, 2.0, 1.5], [3.0, -1.0, 0.5])
    target = g.transform_points(g.invert_transform(T), [3.0, -1.0, 0.5])
    np.testing.assert_allclose(target[:2], 0, atol=1e-12)
    assert target[2] > 0
    assert T[2, 0] == pytest.approx(0)
    assert T[2, 1] < 0
    np.testing.assert_allclose(np.linalg.det(T[:3, :3]), 1)


def test_crop_and_resize_move_the_same_point():
    camera = g.Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0)
    view = camera.cropped(0, 40, 336, 111).resized(200, 66)
    point = np.array([0.3, 0.1, 2.0])
    u, v = camera.project(point)
    np.testing.assert_allclose(view.project(point), [u * 200 / 336, (v - 40) * 66 / 111])


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ((240, 180, 0.708, 0.944, 0.5, 0.5), "if they are normalised"),
        ((240, 180, 170.0, 170.0, 0.5, 0.5), "if they are normalised"),
        ((336, 188, 1.7, 170.0, 168.0, 94.0), "if they are normalised"),
        ((336, 188, 170.0, 170.0, 5000.0, 94.0), "larger image"),
        ((120, 90, 170.0, 170.0, 120.0, 90.0), "larger image"),
        ((120, 90, 170.0, 170.0, 60.0, -1.0), "larger image"),
    ],
)
def test_intrinsics_that_no_camera_has_are_refused(values, why):
    with pytest.raises(
        ValueError, match=f"in pixels of an image of {values[0]} x {values[1]}, got fx .*{why}"
    ):
        g.require_camera(g.Pinhole(*values))


@pytest.mark.parametrize("degrees", [0.2, 20.0, 120.0, 165.0])
def test_cameras_from_telescopes_to_the_widest_lenses_pass(degrees):
    f = 320.0 / np.tan(np.radians(degrees / 2))
    for centre in ((320.0, 240.0), (0.0, 0.0), (639.5, 2.0)):
        g.require_camera(g.Pinhole(640, 480, f, f, *centre))
    fisheye = 640 / np.radians(235.0)  # equidistant: the angle is the radius over the focal length
    g.require_camera(g.Pinhole(640, 480, fisheye, fisheye, 320.0, 240.0))


def test_directions_are_the_inverse_of_projection():
    camera = g.Pinhole(4, 3, 5.0, 6.0, 1.9, 1.4)
    np.testing.assert_allclose(camera.project(camera.directions())[1, 2], [2.5, 1.5])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: g.Pinhole(0, 3, 1, 1, 0, 0), "positive image size"),
        (lambda: g.Pinhole(3, 3, -1, 1, 0, 0), "positive focal lengths"),
        (lambda: g.Pinhole(3, 3, 1, 1, 0, 0).cropped(1, 0, 3, 3), "inside 3 x 3"),
        (lambda: g.rotation_from_quaternion([0, 0, 0, 0]), "unit length"),
        (lambda: g.look_at([0, 0, 1], [0, 0, 0]), "straight above"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_the_leaf_loads_neither_torch_nor_scipy():
    code = "import sys, advnerf_core.geometry; sys.exit(any(m in sys.modules for m in ('torch', 'scipy', 'cv2')))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
