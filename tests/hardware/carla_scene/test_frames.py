"""Handedness and rotations, against the real client library."""

import math

import numpy as np
import pytest

from advnerf_core.geometry import camera_mount, invert_transform, planar_pose, transform_points
from hardware.worlds.carla.frames import BODY_FROM_CAMERA, CarlaPose, SceneFrame

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
# Every combination of signs and quadrants, and both poles.
POSES = [
    CarlaPose(3.0, -7.0, 1.5, pitch, yaw, roll)
    for pitch in (-90.0, -35.0, 0.0, 20.0, 90.0)
    for yaw in (-170.0, -90.0, 0.0, 33.0, 180.0)
    for roll in (-80.0, 0.0, 15.0, 120.0)
]


def test_matrix_is_the_librarys_mirrored(carla):
    for pose in POSES:
        theirs = np.array(pose.to_transform(carla).get_matrix())
        np.testing.assert_allclose(pose.matrix, MIRROR @ theirs @ MIRROR, atol=3e-6, err_msg=str(pose))


def test_points_go_where_the_library_sends_them(carla):
    pose = CarlaPose(12.0, -5.0, 2.0, 12.0, -140.0, 30.0)
    for local in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [2.0, -3.0, 0.5]):
        x, y, z = transform_points(pose.matrix, [local[0], -local[1], local[2]])
        there = pose.to_transform(carla).transform(carla.Location(*local))
        assert (there.x, there.y, there.z) == pytest.approx((x, -y, z), abs=1e-5)


def test_pose_comes_back_from_its_matrix():
    for pose in POSES:
        np.testing.assert_allclose(
            CarlaPose.from_matrix(pose.matrix).matrix, pose.matrix, atol=1e-9, err_msg=str(pose)
        )


def test_reads_a_transform_of_the_library(carla):
    given = carla.Transform(carla.Location(1.5, -2.5, 3.5), carla.Rotation(pitch=10.0, yaw=20.0, roll=30.0))
    assert CarlaPose.of(given) == CarlaPose(1.5, -2.5, 3.5, 10.0, 20.0, 30.0)


def test_a_camera_axis_by_axis(carla):
    """Our camera's z, x and -y are what the library calls forward, right and up."""
    frame = SceneFrame(100.0, 40.0, 2.5, 0.7)
    T = planar_pose(4.0, -3.0, -2.1) @ camera_mount(1.2, 0.1, 1.5, 0.14, 0.2)
    transform = frame.camera_pose(T).to_transform(carla)
    R = (frame.T_mirrored_from_world @ T)[:3, :3]
    for vector, ours in (
        (transform.get_forward_vector(), R[:, 2]),
        (transform.get_right_vector(), R[:, 0]),
        (transform.get_up_vector(), -R[:, 1]),
    ):
        np.testing.assert_allclose([vector.x, -vector.y, vector.z], ours, atol=1e-6)


def test_scene_frame_goes_there_and_back(carla):
    frame = SceneFrame(100.0, 40.0, 2.5, 0.7)
    T = planar_pose(4.0, -3.0, -2.1) @ camera_mount(1.2, 0.1, 1.5, 0.14, 0.2)
    through_the_library = CarlaPose.of(frame.camera_pose(T).to_transform(carla))
    np.testing.assert_allclose(frame.world_from_body(through_the_library) @ BODY_FROM_CAMERA, T, atol=2e-5)
    np.testing.assert_allclose(frame.world_from_body(frame.body_pose(T)), T, atol=1e-12)
    x, y, z = frame.carla_point([4.0, -3.0, 0.5])
    there = transform_points(invert_transform(frame.T_mirrored_from_world), [x, -y, z])
    np.testing.assert_allclose(there, [4.0, -3.0, 0.5], atol=1e-12)


def test_left_is_left():
    """A left turn of ours is a negative yaw of CARLA's, and what is on our left has the smaller y there."""
    frame = SceneFrame(0.0, 0.0, 0.0, 0.0)
    assert frame.body_pose(planar_pose(0.0, 0.0, 0.3)).yaw_deg == pytest.approx(-math.degrees(0.3))
    assert frame.carla_point([0.0, 2.0, 0.0]) == (0.0, -2.0, 0.0)


def test_distance_of_poses():
    one = CarlaPose(1.0, 2.0, 3.0, 10.0, 179.9, 0.0)
    apart_m, turned = one.distance_to(CarlaPose(1.0, 2.3, 3.4, 10.0, -180.0, 0.0))
    assert apart_m == pytest.approx(0.5)
    assert turned == pytest.approx(
        math.radians(0.1), rel=1e-6
    )  # a yaw is a turn about the vertical, whatever the pitch
    assert one.distance_to(one) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert one.distance_to(CarlaPose(1.0, 2.0, 3.0, 10.0, -0.1, 0.0))[1] == pytest.approx(math.pi)
