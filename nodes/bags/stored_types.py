"""Converts topics of a bag to the types of the topic table, using the bag's definitions and equivalent types."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from zstandard import ZstdDecompressor, ZstdError

from nodes.bags.message_definitions import Definition, as_our_message, parse_definition
from nodes.runtime.errors import BagError, MessageError
from nodes.runtime.image_parts import IMAGE_TYPE
from nodes.runtime.messages import decode, encode, fields_of, type_hash, types
from nodes.runtime.pictures import COMPRESSED_TYPE, rgb8_message

POSE_TYPE = "geometry_msgs/msg/PoseStamped"
CDR, ROS1 = "cdr", "ros1"
# rosbag2 can compress single messages. An uncompressed message begins with zeros.
_ZSTD = b"\x28\xb5\x2f\xfd"
_MOST_BYTES = 1 << 28

Convert = Callable[[bytes], bytes]


@dataclass(frozen=True)
class RecordedTopic:
    """Description of one topic of one writer in a bag.

    Attributes:
        topic: Name of the topic.
        type: Full type name.
        type_hash: RIHS01 hash of the type; empty if missing.
        definition: Text of the type's definition; empty if missing.
        definition_language: ``ros2msg``, ``ros1msg``, ``ros2idl``.
        serialization: ``cdr`` or ``ros1``. Other values are not supported.
    """

    topic: str
    type: str
    type_hash: str = ""
    definition: str = ""
    definition_language: str = "ros2msg"
    serialization: str = CDR


def converter(recorded: RecordedTopic, expected: str, source: str) -> Convert | None:
    """Return a converter from recorded bytes to CDR bytes of the expected type; None if no conversion is needed.

    Raises:
        BagError: The topic has a type that cannot be converted to the expected one.
    """
    reshape = None
    if recorded.type != expected:
        reshape = _ACCEPTED.get(expected, {}).get(recorded.type)
        if reshape is None:
            others = _ACCEPTED.get(expected)
            also = f" (or {', '.join(others)})" if others else ""
            raise BagError(
                f"{source}: {recorded.topic} is {recorded.type or 'of no type'}, expected {expected}{also}"
            )
    if recorded.serialization not in (CDR, ROS1):
        raise BagError(
            f"{source}: {recorded.topic} is stored as {recorded.serialization!r}, expected {CDR} or {ROS1}"
        )
    ros1 = recorded.serialization == ROS1
    definition = _foreign_definition(recorded, source)
    if definition is None and reshape is None:
        return None

    def convert(data: bytes) -> bytes:
        try:
            if definition is None:
                message = decode(recorded.type, data)
            else:
                message = as_our_message(definition.read(data, ros1), recorded.type)
            return encode(message if reshape is None else reshape(message, recorded.topic))
        except MessageError as error:
            raise MessageError(f"{source}: {recorded.topic}: {error}") from error

    return convert


def unpacked(data: bytes, topic: str, source: str) -> bytes:
    """Uncompress a message that rosbag2 may have compressed."""
    if not data.startswith(_ZSTD):
        return data
    try:
        return bytes(ZstdDecompressor().decompress(data, max_output_size=_MOST_BYTES))
    except ZstdError as error:
        raise MessageError(f"{source}: {topic}: expected a message compressed with zstd: {error}") from error


def _foreign_definition(recorded: RecordedTopic, source: str) -> Definition | None:
    """Definition for reading a topic; None if advnerf's own type fits."""
    known = fields_of(recorded.type) is not None
    if recorded.serialization == CDR and known:
        if not recorded.definition or recorded.type_hash == type_hash(recorded.type):
            return None
    elif not recorded.definition:
        raise BagError(
            f"{source}: expected a definition of {recorded.type} for {recorded.topic}, found none in the bag"
        )
    try:
        definition = parse_definition(recorded.type, recorded.definition, recorded.definition_language)
        if recorded.serialization == CDR and definition.is_ours:
            return None
        if missing := definition.missing(recorded.type):
            raise MessageError(f"expected the fields {', '.join(missing)}, which its {recorded.type} lacks")
        return definition
    except MessageError as error:
        raise BagError(f"{source}: {recorded.topic}: {error}") from error


def _pose(header: Any, position: Any, orientation: Any) -> Any:
    point = types.Point(x=position.x, y=position.y, z=position.z)
    return types.PoseStamped(header=header, pose=types.Pose(position=point, orientation=orientation))


def _pose_of_transform(message: Any, topic: str) -> Any:
    """Convert a transform to the pose of its child frame in the header's frame."""
    return _pose(message.header, message.transform.translation, message.transform.rotation)


def _pose_of_estimate(message: Any, topic: str) -> Any:
    """Pose of a ``PoseWithCovarianceStamped`` or an ``Odometry``, without its covariance."""
    return _pose(message.header, message.pose.pose.position, message.pose.pose.orientation)


# Equivalent types by expected type.
_ACCEPTED: dict[str, dict[str, Callable[[Any, str], Any]]] = {
    IMAGE_TYPE: {COMPRESSED_TYPE: rgb8_message},
    POSE_TYPE: {
        "geometry_msgs/msg/TransformStamped": _pose_of_transform,
        "geometry_msgs/msg/PoseWithCovarianceStamped": _pose_of_estimate,
        "nav_msgs/msg/Odometry": _pose_of_estimate,
    },
}
