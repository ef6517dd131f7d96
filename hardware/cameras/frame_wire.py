"""Wire format of frames on a Unix socket, for the twin's frame server and its client.

The client sends one byte. The server answers with its newest frame, or with the next one if the client already has it: a fixed head
with both capture stamps, then raw RGB. The head begins with another word where the frame is simulated.
"""

from __future__ import annotations

import struct

import numpy as np

from hardware.cameras.interface import Frame
from hardware.errors import ProtocolError

MAGIC, SIMULATED_MAGIC = b"ADVF", b"ADVS"
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
    magic = SIMULATED_MAGIC if frame.simulated else MAGIC
    return _HEAD.pack(
        magic, VERSION, height, width, frame.sequence, frame.stamp_realtime_ns, frame.stamp_mono_ns
    )


def pixel_bytes(head: bytes) -> int:
    """Number of pixel bytes that follow a head."""
    magic, version, height, width, *_ = _HEAD.unpack(head)
    if magic not in (MAGIC, SIMULATED_MAGIC) or version != VERSION or height == 0 or width == 0:
        raise ProtocolError(
            f"expected a frame head {MAGIC!r} version {VERSION}, got {head[:6]!r}; is the socket that of a frame server"
            " of the same version?"
        )
    return int(height) * int(width) * 3


def decode_frame(head: bytes, pixels: bytes | bytearray) -> Frame:
    """Decode a frame from its head and pixel bytes."""
    if len(pixels) != pixel_bytes(head):
        raise ProtocolError(f"expected {pixel_bytes(head)} pixel bytes, got {len(pixels)}")
    magic, _, height, width, sequence, real_ns, mono_ns = _HEAD.unpack(head)
    rgb = np.frombuffer(pixels, dtype=np.uint8).reshape(height, width, 3)
    rgb.flags.writeable = False
    return Frame(rgb, real_ns, mono_ns, sequence, simulated=magic == SIMULATED_MAGIC)
