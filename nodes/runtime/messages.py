"""ROS 2 messages without ROS: types, CDR bytes, and the conversions that nodes need.

The type definitions come from ROS 2 Jazzy plus the ``.msg`` files shipped in ``nodes/runtime/msg``. No other definition is
registered, because the code generator behind them runs code made from a definition. Definitions from foreign bags never reach it.

Decoded arrays are read-only views of the received bytes: copy before drawing on them.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.serde import SerdeError

from advnerf_core.geometry import Pinhole, make_transform, quaternion_from_rotation, rotation_from_quaternion
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import MessageError
from nodes.runtime.message_types import MSG_FOLDER, MessageTypes

ROS_DISTRO = "jazzy"
# Far above every message of advnerf. A corrupt length field must not make a receiver allocate gigabytes.
MAX_SEQUENCE_LENGTH = 64 * 1024 * 1024
_CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}


_TYPES = MessageTypes(MAX_SEQUENCE_LENGTH)
_PACKAGES = (
    "builtin_interfaces",
    "std_msgs",
    "geometry_msgs",
    "sensor_msgs",
    "diagnostic_msgs",
    "rosgraph_msgs",
    "nav_msgs",
    "ackermann_msgs",
    "advnerf_msgs",
)


class _Types:
    """Message classes by short name, such as ``types.Image``. See ``nodes/runtime/msg`` for advnerf's own."""

    def __getattr__(self, name: str) -> Any:
        if (typename := _TYPES.find(name, _PACKAGES)) is None:
            raise AttributeError(f"no message type called {name} in {', '.join(_PACKAGES)}")
        setattr(self, name, found := _TYPES.types[typename])
        return found


types = _Types()
"""Message classes by short name, as in ``types.PoseStamped(header=..., pose=...)``: ROS 2 types, and ours in ``nodes/runtime/msg``."""


def type_name(message: Any) -> str:
    """Full ROS 2 type name of a message, for example ``sensor_msgs/msg/Image``."""
    try:
        return str(message.__msgtype__)
    except AttributeError:
        raise MessageError(f"expected a ROS 2 message, got {type(message).__name__}") from None


@cache
def type_hash(typename: str) -> str:
    """RIHS01 hash of a type, in the format of ``ros2 topic info -v``."""
    _require_type(typename)
    return str(_TYPES.hash_rihs01(typename))


@cache
def type_hash_prefix(typename: str) -> bytes:
    """First 8 bytes of the type hash, which are sent with every message."""
    return bytes.fromhex(type_hash(typename).removeprefix("RIHS01_")[:16])


@cache
def type_definition(typename: str) -> str:
    """Definition text of a type and of all types in it, in the format of bags (``ros2msg``)."""
    _require_type(typename)
    return str(_TYPES.generate_msgdef(typename, ros_version=2)[0])


def encode(message: Any) -> bytes:
    """Encode a message to CDR bytes."""
    name = type_name(message)
    try:
        return bytes(_TYPES.serialize_cdr(message, name))
    except (SerdeError, struct.error, AttributeError, TypeError, ValueError) as error:
        raise MessageError(
            f"expected fields that fit {name}, got a wrong type or a value out of range: {error}"
        ) from error


def decode(typename: str, data: bytes | memoryview) -> Any:
    """Decode CDR bytes to a message whose arrays are read-only views of ``data``."""
    _require_type(typename)
    try:
        return _TYPES.deserialize_cdr(memoryview(data).toreadonly(), typename)
    except (SerdeError, struct.error, ValueError, IndexError, UnicodeDecodeError, AssertionError) as error:
        raise MessageError(
            f"expected CDR bytes of {typename}, got {len(data)} bytes that cannot be decoded: {error}"
        ) from error


def fields_of(typename: str) -> list[tuple[str, Any]] | None:
    """Names and kinds of the fields of a type, as ``rosbags`` describes them; None for an unknown type."""
    return list(_TYPES.fielddefs[typename][1]) if _TYPES.has(typename) else None


def message_class(typename: str) -> Any:
    """Message class of a type."""
    _require_type(typename)
    return _TYPES.types[typename]


def stamp_from_ns(stamp_ns: int) -> Any:
    """Convert a real time [ns] to ``builtin_interfaces/Time``."""
    return types.Time(sec=int(stamp_ns) // NS_PER_S, nanosec=int(stamp_ns) % NS_PER_S)


def ns_from_stamp(stamp: Any) -> int:
    """Convert a ``builtin_interfaces/Time`` to a real time [ns]."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def header(stamp_ns: int, frame_id: str = "") -> Any:
    """Make a ``std_msgs/Header`` from a real time [ns] and a frame."""
    return types.Header(stamp=stamp_from_ns(stamp_ns), frame_id=frame_id)


def stamp_ns(message: Any) -> int:
    """Real time [ns] in the header of a message."""
    return ns_from_stamp(message.header.stamp)


def image_message(image: NDArray[np.uint8], stamp_ns: int, frame_id: str, encoding: str = "rgb8") -> Any:
    """``sensor_msgs/Image`` of pixels ``[H, W, 3]`` uint8 (or ``[H, W]`` with encoding mono8)."""
    channels = _CHANNELS.get(encoding)
    if channels is None:
        raise MessageError(f"expected an encoding of {', '.join(_CHANNELS)}, got {encoding!r}")
    shape_fits = image.ndim == 2 if channels == 1 else image.ndim == 3 and image.shape[2] == channels
    if image.dtype != np.uint8 or not shape_fits:
        raise MessageError(f"expected a uint8 image for {encoding}, got {image.dtype} {list(image.shape)}")
    height, width = image.shape[:2]
    return types.Image(
        header=header(stamp_ns, frame_id),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=width * channels,
        data=np.ascontiguousarray(image).reshape(-1),
    )


def pose_message(T_frame_from_body: ArrayLike, stamp_ns: int, frame_id: str = "world") -> Any:
    """Make a ``geometry_msgs/PoseStamped`` from a transform ``[4, 4]`` from body coordinates to ``frame_id``."""
    T = np.asarray(T_frame_from_body, dtype=np.float64)
    x, y, z, w = (float(q) for q in quaternion_from_rotation(T[:3, :3]))
    position = types.Point(x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3]))
    pose = types.Pose(position=position, orientation=types.Quaternion(x=x, y=y, z=z, w=w))
    return types.PoseStamped(header=header(stamp_ns, frame_id), pose=pose)


def pose_matrix(message: Any) -> NDArray[np.float64]:
    """Convert a ``PoseStamped`` to a transform ``[4, 4]``. A quaternion of length zero is an error."""
    position, q = message.pose.position, message.pose.orientation
    try:
        rotation = rotation_from_quaternion([q.x, q.y, q.z, q.w])
    except ValueError as error:
        raise MessageError(f"expected a pose with an orientation: {error}") from error
    return make_transform(rotation, np.array([position.x, position.y, position.z]))


def finite_pose(message: Any) -> NDArray[np.float64] | None:
    """Convert a ``PoseStamped`` to a transform ``[4, 4]``; None for one that is no pose: with a number that is not finite, or no orientation."""
    try:
        T = pose_matrix(message)
    except MessageError:
        return None
    return T if np.isfinite(T).all() else None


def drive_message(speed_mps: float, steering_rad: float, stamp_ns: int, frame_id: str = "car") -> Any:
    """Make an ``AckermannDriveStamped``. ``stamp_ns`` is the capture time of the image that the command is based on."""
    drive = types.AckermannDrive(
        steering_angle=float(steering_rad),
        steering_angle_velocity=0.0,
        speed=float(speed_mps),
        acceleration=0.0,
        jerk=0.0,
    )
    return types.AckermannDriveStamped(header=header(stamp_ns, frame_id), drive=drive)


def camera_info_message(
    pinhole: Pinhole, stamp_ns: int, frame_id: str, distortion: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0)
) -> Any:
    """``sensor_msgs/CameraInfo`` of intrinsics and OpenCV's distortion coefficients ``[5]``.

    ROS puts pixel centres at integers, so half a pixel is taken off the principal point.
    """
    K = pinhole.matrix.copy()
    K[:2, 2] -= 0.5
    P = np.hstack([K, np.zeros((3, 1))])
    window = types.RegionOfInterest(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return types.CameraInfo(
        header=header(stamp_ns, frame_id),
        height=pinhole.height,
        width=pinhole.width,
        distortion_model="plumb_bob",
        d=np.asarray(distortion, dtype=np.float64),
        k=K.reshape(-1),
        r=np.eye(3).reshape(-1),
        p=P.reshape(-1),
        binning_x=0,
        binning_y=0,
        roi=window,
    )


def _require_type(typename: str) -> None:
    if not _TYPES.has(typename):
        raise MessageError(f"expected a message type of ROS 2 or of {MSG_FOLDER}, got {typename!r}")
