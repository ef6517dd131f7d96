"""Wire format of frames on a Unix socket, for the twin's frame server and its client.

The client sends one byte. The server answers with its newest frame, or with the next one if the client already has it: a fixed head
with both capture stamps, then raw RGB.
"""

from __future__ import annotations

import struct

import numpy as np

from hardware.cameras.interface import Frame
from hardware.errors import ProtocolError

MAGIC = b"ADVF"
VERSION = 1
REQUEST = b"?"
# magic, version, height, width, sequence, capture real time [ns], capture monotonic time [ns].
_HEAD = struct.Struct("<4sHHHQqq")
HEAD_BYTES = _HEAD.size


def encode_head(frame: Frame) -> bytes:
    """Encode the head of a frame. The pixels follow as ``frame.rgb.tobytes()``."""
    height, width, channels = frame.rgb.shape
    if channels != 3 or frame.rgb.dtype != np.uint8:
        raise ValueError(f"expected uint8 pixels [H, W, 3], got {frame.rgb.dtype} {list(frame.rgb.shape)}")
    return _HEAD.pack(
        MAGIC, VERSION, height, width, frame.sequence, frame.stamp_realtime_ns, frame.stamp_mono_ns
    )


def pixel_bytes(head: bytes) -> int:
    """Number of pixel bytes that follow a head."""
    magic, version, height, width, *_ = _HEAD.unpack(head)
    if magic != MAGIC or version != VERSION or height == 0 or width == 0:
        raise ProtocolError(
            f"expected a frame head {MAGIC!r} version {VERSION}, got {head[:6]!r}; is the socket that of a frame server"
            " of the same version?"
        )
    return int(height) * int(width) * 3


def decode_frame(head: bytes, pixels: bytes | bytearray) -> Frame:
    """Decode a frame from its head and pixel bytes."""
    if len(pixels) != pixel_bytes(head):
        raise ProtocolError(f"expected {pixel_bytes(head)} pixel bytes, got {len(pixels)}")
    _, _, height, width, sequence, real_ns, mono_ns = _HEAD.unpack(head)
    rgb = np.frombuffer(pixels, dtype=np.uint8).reshape(height, width, 3)
    rgb.flags.writeable = False
    return Frame(rgb, real_ns, mono_ns, sequence)
