"""DDS types of ROS 2 messages whose samples are CDR bytes: nothing is decoded or encoded on the way.

A ROS 2 type ``sensor_msgs/msg/Image`` is called ``sensor_msgs::msg::dds_::Image_`` in DDS. The fields only describe the type to other
participants, which may compare it with theirs.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl import types as idl
from rosbags.interfaces import Nodetype

from nodes.linking.ros2.routes import dds_name
from nodes.runtime.errors import MessageError
from nodes.runtime.messages import fields_of

_BASE = {
    "bool": bool,
    "byte": idl.byte,
    "char": idl.uint8,
    "int8": idl.int8,
    "uint8": idl.uint8,
    "int16": idl.int16,
    "uint16": idl.uint16,
    "int32": idl.int32,
    "uint32": idl.uint32,
    "int64": idl.int64,
    "uint64": idl.uint64,
    "float32": idl.float32,
    "float64": idl.float64,
    "string": str,
}


def dds_topic(ros_name: str) -> str:
    """Name of a ROS 2 topic in DDS."""
    return f"rt{ros_name}"


@cache
def bytes_type(typename: str) -> Any:
    """Class of the samples of a ROS 2 type: made of CDR bytes, which are its attribute ``cdr``."""
    found = _struct(typename)

    def take_bytes(sample: Any, cdr: bytes) -> None:
        sample.cdr = cdr

    def give_bytes(sample: Any, *_: Any, **__: Any) -> bytes:
        return bytes(sample.cdr)

    def from_bytes(cls: Any, data: bytes, *_: Any, **__: Any) -> Any:
        return cls(data)

    def no_key(cls: Any, *_: Any, **__: Any) -> Any:
        return cls(b"")  # the sample that reports that a publisher has left

    found.__init__ = take_bytes
    found.serialize = give_bytes
    found.deserialize = classmethod(from_bytes)
    found.deserialize_key = classmethod(no_key)
    return found


def _struct(typename: str) -> Any:
    fields = fields_of(typename)
    if fields is None:
        raise MessageError(f"expected a message type of ROS 2 or of advnerf, got {typename!r}")
    described = {name: _field(kind) for name, kind in fields}
    made: type[IdlStruct] = make_idl_struct(
        typename.rsplit("/", 1)[1] + "_", dds_name(typename), described, dataclassify=False
    )
    return made


_nested = cache(_struct)


def _field(kind: Any) -> Any:
    nodetype, detail = kind
    if nodetype == Nodetype.BASE:
        return _BASE[detail[0]]
    if nodetype == Nodetype.NAME:
        return _nested(detail)
    inner, length = _field(detail[0]), detail[1]
    if nodetype == Nodetype.ARRAY:
        return idl.array.__class_getitem__((inner, length))
    return idl.sequence.__class_getitem__((inner, length) if length else inner)
