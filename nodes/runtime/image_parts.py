"""Images are sent in two parts, so that their pixels are not copied.

``data`` is the last field of ``sensor_msgs/Image``. The fields before it form a short prefix, of which only the stamp changes from
image to image. Prefix and pixels joined are the CDR bytes of the image, which recorders receive.
"""

from __future__ import annotations

import struct
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from nodes.runtime.errors import MessageError
from nodes.runtime.messages import decode, encode, header, types
from nodes.runtime.wire import MessageInfo

IMAGE_TYPE = "sensor_msgs/msg/Image"
# Smaller images are copied, because a copy costs less than a second frame.
_WORTH_BYTES = 16 * 2**10
_STAMP, _LENGTH = struct.Struct("<iI"), struct.Struct("<I")
_STAMP_AT = 4  # after the encapsulation header of CDR
_REST_AT = _STAMP_AT + _STAMP.size


def split_image(message: Any) -> tuple[bytes, memoryview] | None:
    """Split an image message into prefix and pixels; None if it should be sent in one piece."""
    data = message.data
    if (
        not isinstance(data, np.ndarray)
        or data.dtype != np.uint8
        or data.nbytes < _WORTH_BYTES
        or not data.flags.c_contiguous
    ):
        return None
    rest = _rest(
        message.header.frame_id,
        message.height,
        message.width,
        message.encoding,
        message.is_bigendian,
        message.step,
    )
    stamp = message.header.stamp
    try:
        prefix = b"".join(
            (
                rest[:_STAMP_AT],
                _STAMP.pack(stamp.sec, stamp.nanosec),
                rest[_REST_AT:],
                _LENGTH.pack(data.nbytes),
            )
        )
    except struct.error as error:
        raise MessageError(f"a stamp of {IMAGE_TYPE} is out of range: {error}") from error
    return prefix, data.data


def join_image(prefix: bytes, pixels: bytes) -> Any:
    """Join two parts to an image message whose data is a read-only view of ``pixels``."""
    if len(prefix) < _REST_AT + _LENGTH.size or _LENGTH.unpack(prefix[-_LENGTH.size :])[0] != len(pixels):
        raise MessageError(
            f"expected the two parts of {IMAGE_TYPE}, got {len(prefix)} and {len(pixels)} bytes"
        )
    sample = _sample(prefix[:_STAMP_AT], prefix[_REST_AT : -_LENGTH.size])
    sec, nanosec = _STAMP.unpack_from(prefix, _STAMP_AT)
    return types.Image(
        header=types.Header(stamp=types.Time(sec=sec, nanosec=nanosec), frame_id=sample.header.frame_id),
        height=sample.height,
        width=sample.width,
        encoding=sample.encoding,
        is_bigendian=sample.is_bigendian,
        step=sample.step,
        data=np.frombuffer(pixels, dtype=np.uint8),
    )


class PartedInfo(MessageInfo):
    """A `MessageInfo` of an image in two parts. ``raw`` is joined on first access."""

    parts: tuple[bytes, bytes]

    @cached_property
    def raw(self) -> bytes:
        """The CDR bytes."""
        return b"".join(self.parts)


def with_parts(info: MessageInfo, parts: tuple[bytes, bytes]) -> PartedInfo:
    """Convert the info of an image that was received in two parts."""
    parted = PartedInfo(**vars(info))
    del parted.__dict__["raw"]
    parted.__dict__["parts"] = parts
    return parted


@lru_cache(maxsize=64)
def _rest(frame_id: str, height: int, width: int, encoding: str, is_bigendian: int, step: int) -> bytes:
    """CDR bytes of an image between its stamp and its pixel data."""
    empty = types.Image(
        header=header(0, frame_id),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=is_bigendian,
        step=step,
        data=np.empty(0, np.uint8),
    )
    return encode(empty)[: -_LENGTH.size]


@lru_cache(maxsize=64)
def _sample(start: bytes, rest: bytes) -> Any:
    """Decode a prefix to a message without stamp and pixels."""
    return decode(IMAGE_TYPE, b"".join((start, bytes(_STAMP.size), rest, bytes(_LENGTH.size))))
