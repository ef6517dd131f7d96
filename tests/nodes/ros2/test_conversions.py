"""Conversions between our types and those of ROS tools."""

import math

import numpy as np
import pytest

from advnerf_core.geometry import planar_pose
from nodes.linking.ros2 import conversions as c
from nodes.linking.ros2.conversions import Setting, conversion, convertible
from nodes.runtime.messages import decode, drive_message, encode, header, pose_message, types

CAR = Setting(wheelbase_m=0.25, child_frame="base_link", frame="map")


def twist(speed_mps, yaw_radps):
    linear, angular = types.Vector3(x=speed_mps, y=0.0, z=0.0), types.Vector3(x=0.0, y=0.0, z=yaw_radps)
    return types.TwistStamped(
        header=header(7, "base_link"), twist=types.Twist(linear=linear, angular=angular)
    )


@pytest.mark.parametrize("speed_mps", [0.8, -0.5, 0.05])
@pytest.mark.parametrize("steering_rad", [-0.3, 0.0, 0.2])
def test_a_twist_gives_the_circle_of_the_steering_angle(speed_mps, steering_rad):
    made = c.twist_from_ackermann(drive_message(speed_mps, steering_rad, 7), CAR)
    assert made.twist.linear.x == pytest.approx(speed_mps)
    if steering_rad:
        # Kinematic bicycle, rear axle: radius = wheelbase / tan(steering).
        assert made.twist.linear.x / made.twist.angular.z == pytest.approx(0.25 / math.tan(steering_rad))
    back = c.ackermann_from_twist(made, CAR)
    assert (back.drive.speed, back.drive.steering_angle) == pytest.approx((speed_mps, steering_rad))
    assert back.header == made.header


def test_a_car_at_rest_has_straight_wheels():
    assert c.ackermann_from_twist(twist(0.0, 3.0), CAR).drive.steering_angle == 0.0


@pytest.mark.parametrize(
    ("speed_mps", "yaw_radps"),
    [(math.nan, 0.0), (0.0, math.nan), (0.5, math.inf * 0), (math.inf, 0.0), (1e300, 0.0)],
)
def test_what_is_not_finite_stays_so_and_can_be_encoded(speed_mps, yaw_radps):
    made = c.ackermann_from_twist(twist(speed_mps, yaw_radps), CAR)
    read = decode(c.ACKERMANN, encode(made))
    assert not (math.isfinite(read.drive.speed) and math.isfinite(read.drive.steering_angle))


def test_a_pose_becomes_a_transform_to_the_body():
    pose = pose_message(planar_pose(1.0, -2.0, 0.5), 9, "world")
    (made,) = c.tf_from_pose(pose, CAR).transforms
    assert (made.header.frame_id, made.child_frame_id, made.header.stamp) == (
        "map",
        "base_link",
        pose.header.stamp,
    )
    assert (made.transform.translation.x, made.transform.translation.y) == (1.0, -2.0)
    assert made.transform.rotation == pose.pose.orientation
    (own,) = c.tf_from_pose(pose, Setting(child_frame="car")).transforms
    assert (own.header.frame_id, own.child_frame_id) == ("world", "car")


def test_odometry_gives_pose_and_transform():
    pose = pose_message(planar_pose(1.0, -2.0, 0.5), 9, "odom")
    zero = types.Vector3(x=0.0, y=0.0, z=0.0)
    covariance = np.zeros(36)
    odometry = types.Odometry(
        header=pose.header,
        child_frame_id="car",
        pose=types.PoseWithCovariance(pose=pose.pose, covariance=covariance),
        twist=types.TwistWithCovariance(twist=types.Twist(linear=zero, angular=zero), covariance=covariance),
    )
    assert c.pose_from_odometry(odometry, CAR) == pose
    assert c.tf_from_odometry(odometry, CAR) == c.tf_from_pose(pose, CAR)


def diagnostics(made):
    (status,) = decode(c.DIAGNOSTICS, encode(made)).status
    return status.name, int(status.level), status.message, {each.key: each.value for each in status.values}


def test_stamps_of_attacks_are_readable_without_our_types():
    stamp = types.AttackStamp(header=header(5, "camera"), attack_id="ab12", drawn=True, reason="")
    made = c.diagnostics_from_attack(stamp, Setting())
    assert made.header == stamp.header
    assert diagnostics(made) == ("advnerf: attack", 0, "", {"attack_id": "ab12", "drawn": "true"})


def test_states_become_levels():
    status = types.NodeStatus(
        header=header(5),
        node="camera",
        pid=1,
        state="fault",
        text="unplugged",
        subscriptions=[],
        publications=[],
        subscribers=np.zeros(0, np.uint32),
        counter_names=["images"],
        counter_values=np.array([3.0]),
    )
    assert diagnostics(c.diagnostics_from_status(status, CAR)) == (
        "advnerf: camera",
        2,
        "unplugged",
        {"state": "fault", "images": "3"},
    )


def test_every_conversion_is_found_by_its_types():
    for outward in (True, False):
        for ours in (c.ACKERMANN, c.POSE, c.ODOMETRY):
            for theirs in convertible(ours, outward):
                assert callable(conversion(ours, theirs, outward))
    assert c.TWIST in convertible(c.ACKERMANN, outward=False)
    assert list(convertible(c.IMAGE, outward=False)) == []
