"""Vicon Tracker's "UDP object stream": bytes to poses and back, no I/O and no clock.

Little-endian, packed: frame number u32, item count u8, then per item: id u8, data size u16 (72), name char[24] padded with zeros,
translation 3 x f64 [mm], rotation 3 x f64 [rad] (Euler XYZ intrinsic, ``R = Rx Ry Rz``). Datagrams are usually padded to the block
size set in Tracker (256, 512 or 1024 bytes: at most 3, 6 or 13 objects); larger sets come as several datagrams of one frame
number. Five independent public readers agree on this layout.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, make_transform, rotation_x, rotation_y, rotation_z
from hardware.errors import ProtocolError

_HEADER = struct.Struct("<IB")
_ITEM = struct.Struct("<BH24s6d")
_ITEM_HEAD = struct.Struct("<BH24s")
_ITEM_DATA_BYTES = 72
_NAME_BYTES = 24
BLOCK_SIZES = (256, 512, 1024)


@dataclass(frozen=True)
class ObjectPose:
    """One tracked object in Tracker's units.

    Attributes:
        name: Subject name.
        translation_mm: Position of its origin in the world [mm].
        rotation_rad: Euler angles about x, then the new y, then the new z [rad].
    """

    name: str
    translation_mm: tuple[float, float, float]
    rotation_rad: tuple[float, float, float]

    @property
    def T_world_from_subject(self) -> Array:
        """Pose as a transform ``[4, 4]`` [m]."""
        rx, ry, rz = self.rotation_rad
        R = rotation_x(rx) @ rotation_y(ry) @ rotation_z(rz)
        return make_transform(R, np.asarray(self.translation_mm) / 1000.0)


@dataclass(frozen=True)
class ObjectBlock:
    """One datagram: some or all objects of one frame."""

    frame_number: int
    objects: tuple[ObjectPose, ...]


def object_pose(name: str, T_world_from_subject: NDArray[np.float64]) -> ObjectPose:
    """Wire form of a pose ``[4, 4]`` [m]."""
    T = np.asarray(T_world_from_subject, dtype=np.float64)
    x, y, z = (T[:3, 3] * 1000.0).tolist()
    return ObjectPose(name, (x, y, z), euler_from_rotation(T[:3, :3]))


def euler_from_rotation(R: NDArray[np.float64]) -> tuple[float, float, float]:
    """Angles with ``R = Rx Ry Rz`` of a rotation ``[3, 3]``; where y points along x (gimbal lock) the z angle is 0."""
    ry = math.asin(min(max(float(R[0, 2]), -1.0), 1.0))
    if abs(R[0, 2]) > 1.0 - 1e-12:
        return math.atan2(R[2, 1], R[1, 1]), ry, 0.0
    return math.atan2(-R[1, 2], R[2, 2]), ry, math.atan2(-R[0, 1], R[0, 0])


def decode_block(datagram: bytes) -> ObjectBlock:
    """Read one datagram; padding after the counted items is ignored, and so are additions of newer versions to an item."""
    if len(datagram) < _HEADER.size:
        raise ProtocolError(
            f"expected a VICON object block of at least {_HEADER.size} bytes, got {len(datagram)}"
        )
    frame_number, count = _HEADER.unpack_from(datagram)
    offset, objects = _HEADER.size, []
    for index in range(count):
        if offset + _ITEM_HEAD.size + 48 > len(datagram):
            raise ProtocolError(
                f"expected {count} objects in VICON frame {frame_number}, but the datagram of {len(datagram)} bytes ends in number"
                f" {index}; is the receive buffer or the network's packet size too small?"
            )
        _, size, raw_name, *numbers = _ITEM.unpack_from(datagram, offset)
        if size < _ITEM_DATA_BYTES:
            raise ProtocolError(
                f"expected objects of {_ITEM_DATA_BYTES} bytes, got {size}; is this Tracker's object stream?"
            )
        name = raw_name.split(b"\0", 1)[0].decode("utf-8", "replace")
        objects.append(ObjectPose(name, tuple(numbers[:3]), tuple(numbers[3:])))
        offset += 3 + size
    return ObjectBlock(frame_number, tuple(objects))


def encode_blocks(frame_number: int, objects: list[ObjectPose], block_bytes: int = 1024) -> list[bytes]:
    """Datagrams of one frame, each padded to ``block_bytes``; one (empty) block if there are no objects."""
    if block_bytes not in BLOCK_SIZES:
        raise ValueError(f"expected a block size of {BLOCK_SIZES}, got {block_bytes}")
    per_block = (block_bytes - _HEADER.size) // _ITEM.size
    groups = [objects[i : i + per_block] for i in range(0, len(objects), per_block)] or [[]]
    return [_encode_block(frame_number, group, block_bytes) for group in groups]


def _encode_block(frame_number: int, objects: list[ObjectPose], block_bytes: int) -> bytes:
    parts = [_HEADER.pack(frame_number & 0xFFFFFFFF, len(objects))]
    for item in objects:
        name = item.name.encode()
        if not 1 <= len(name) <= _NAME_BYTES:
            raise ValueError(f"expected a subject name of 1 to {_NAME_BYTES} bytes, got {item.name!r}")
        parts.append(_ITEM.pack(0, _ITEM_DATA_BYTES, name, *item.translation_mm, *item.rotation_rad))
    return b"".join(parts).ljust(block_bytes, b"\0")
