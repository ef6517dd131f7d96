import contextlib
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from advnerf_core.geometry import Pinhole, make_transform, rotation_x, rotation_z
from nodes.runtime.clock import ManualClock
from nodes.runtime.errors import MessageError, TopicError
from nodes.runtime.messages import (
    camera_info_message,
    decode,
    drive_message,
    encode,
    finite_pose,
    header,
    image_message,
    pose_matrix,
    pose_message,
    stamp_ns,
    type_definition,
    type_hash,
    type_hash_prefix,
    types,
)
from nodes.runtime.paths import socket_path
from nodes.runtime.topics import TOPICS, status_topic, topic
from nodes.runtime.wire import Meta, pack_meta, unpack
from tests.support.camera_info import pinhole_from_camera_info

pytestmark = pytest.mark.live

DRIVE = "ackermann_msgs/msg/AckermannDriveStamped"


def test_cdr_bytes_of_a_drive_command_written_by_hand():
    # CDR: encapsulation, int32 sec, uint32 nanosec, string with its length and final zero, padding to 4, five float32.
    expected = b"\x00\x01\x00\x00" + struct.pack("<iI", 12, 345) + struct.pack("<I", 4) + b"car\x00"
    expected += struct.pack("<5f", 0.25, 0, 0.8, 0, 0)
    assert encode(drive_message(0.8, 0.25, 12_000_000_345)) == expected
    message = decode(DRIVE, expected)
    assert (message.drive.steering_angle, message.header.frame_id, stamp_ns(message)) == (
        0.25,
        "car",
        12_000_000_345,
    )


def test_type_hash_is_that_of_ros():
    # As `ros2 topic info -v` prints it for an image.
    rihs = "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"
    assert type_hash("sensor_msgs/msg/Image") == rihs
    assert type_hash_prefix("sensor_msgs/msg/Image") == bytes.fromhex("d31d41a9a4c4bc8e")


def test_definition_contains_everything_below():
    text = type_definition(DRIVE)
    for part in (
        "MSG: ackermann_msgs/AckermannDrive",
        "MSG: std_msgs/Header",
        "MSG: builtin_interfaces/Time",
    ):
        assert part in text


@pytest.mark.parametrize(
    "pixels", [np.zeros((2, 3)), np.zeros((2, 3), np.uint8), np.zeros((2, 3, 4), np.uint8)]
)
def test_what_is_no_image_is_refused(pixels):
    with pytest.raises(MessageError, match="expected a uint8 image for rgb8"):
        image_message(pixels, 0, "camera")


def test_pose_survives_the_wire():
    T = make_transform(rotation_z(2.0) @ rotation_x(0.3), [1.0, -2.0, 0.5])
    message = decode("geometry_msgs/msg/PoseStamped", encode(pose_message(T, 5)))
    np.testing.assert_allclose(pose_matrix(message), T, atol=1e-12)


def test_pose_without_orientation_is_refused():
    message = pose_message(np.eye(4), 0)
    message.pose.orientation.w = 0.0
    with pytest.raises(MessageError, match="expected a pose with an orientation"):
        pose_matrix(message)


@pytest.mark.parametrize("field", ["position.z", "orientation.w", "orientation"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pose_with_a_number_that_is_none_or_without_orientation_is_no_pose(field, value):
    message = pose_message(make_transform(rotation_z(0.3), [1.0, 2.0, 0.0]), 0)
    np.testing.assert_array_equal(finite_pose(message), pose_matrix(message))
    o = message.pose.orientation
    if field == "orientation":
        o.x = o.y = o.z = o.w = 0.0
    else:
        part, name = field.split(".")
        setattr(getattr(message.pose, part), name, value)
    assert finite_pose(message) is None


def test_camera_info_has_the_principal_point_of_ros_and_comes_back_as_ours():
    pinhole = Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0)
    message = decode(
        "sensor_msgs/msg/CameraInfo", encode(camera_info_message(pinhole, 5, "camera", [0.1, 0, 0, 0, 0]))
    )
    # ROS counts pixel centres from 0, so the centre of 336 columns is 167.5.
    assert (message.k[2], message.k[5], message.d[0]) == (167.5, 93.5, 0.1)
    assert pinhole_from_camera_info(message) == pinhole


def test_wrong_field_is_a_message_error():
    with pytest.raises(MessageError, match="a wrong type or a value out of range"):
        encode(types.Arm(header=header(0), arm=True, source=3, reason="", ask_id="a", age_ns=0))
    with pytest.raises(MessageError, match="expected a ROS 2 message, got int"):
        encode(3)
    with pytest.raises(MessageError, match="got 'a/b'"):
        decode("a/b", b"")
    with pytest.raises(AttributeError, match="no message type called Nothing"):
        _ = types.Nothing


def test_truncated_bytes_are_refused():
    data = encode(image_message(np.zeros((2, 3, 3), np.uint8), 0, "camera"))
    for length in range(len(data)):
        with pytest.raises(MessageError, match="expected CDR bytes of sensor_msgs/msg/Image"):
            decode("sensor_msgs/msg/Image", data[:length])


@settings(max_examples=300)
@given(
    st.sampled_from(sorted({row.type for row in TOPICS.values()} | {topic("/status/x").type})),
    st.binary(max_size=200),
)
def test_arbitrary_bytes_are_decoded_or_refused_and_nothing_else(typename, noise):
    with contextlib.suppress(MessageError):
        decode(typename, b"\x00\x01\x00\x00" + noise)


@settings(max_examples=100)
@given(st.lists(st.binary(max_size=60), max_size=5))
def test_arbitrary_frames_are_refused(frames):
    with pytest.raises(MessageError):
        unpack("/arm", frames)


def test_frames_are_joined_and_types_checked_before_decoding():
    meta = Meta(1, 2, 3, type_hash_prefix("advnerf_msgs/msg/Arm"), 4)
    assert unpack("/arm", [b"/arm", pack_meta(meta), b"ab", b"cd"]) == (meta, b"abcd")
    with pytest.raises(MessageError, match="run the same version of advnerf"):
        unpack("/safety/state", [b"/safety/state", pack_meta(meta), b""])


def test_every_topic_has_a_type_a_socket_and_a_row(tmp_path):
    for name, row in TOPICS.items():
        assert name == row.name
        assert type_hash(row.type)
        assert len(str(socket_path(tmp_path, name))) <= 107
    assert topic("/status/camera").latest
    with pytest.raises(TopicError, match="known are /camera/image_raw"):
        topic("/camera/image")
    for name in ("Camera", "", "a/b", "x" * 25):
        with pytest.raises(TopicError, match="expected a node name"):
            status_topic(name)


def test_manual_clock_moves_only_when_told():
    clock = ManualClock(10, 1000)
    assert clock.now() == clock.now()
    assert clock.advance(1.5).mono_ns == 1_500_000_010
    assert clock.now().real_ns == 1_500_001_000
    with pytest.raises(ValueError, match="duration >= 0"):
        clock.advance(-1)
