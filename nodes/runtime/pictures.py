"""Pictures for the air: JPEG messages that keep the stamp of their picture, and one decoder for whoever receives pictures.

Nothing here trusts a received picture: its size is read from the header of the JPEG data before they are decoded.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nodes.runtime.errors import MessageError
from nodes.runtime.messages import header, image_array, image_message, stamp_ns, type_name, types

RAW_TOPIC, COMPRESSED_TOPIC = "/camera/image_raw", "/camera/image_raw/compressed"
# As ROS 2's image transport writes it: what the picture was, and what is inside the JPEG.
_FORMAT = "rgb8; jpeg compressed bgr8"
_COMPRESSED_TYPE = "sensor_msgs/msg/CompressedImage"
MAX_PIXELS = 16_000_000
_START, _SCAN = b"\xff\xd8", 0xDA
# Start-of-frame markers hold the size; C4, C8 and CC among them are something else.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_BARE = frozenset({0x01, *range(0xD0, 0xD9)})


def compressed_image_message(rgb: NDArray[np.uint8], stamp_ns: int, frame_id: str, quality: int = 80) -> Any:
    """``sensor_msgs/CompressedImage`` of pixels ``[H, W, 3]`` uint8.

    Args:
        rgb: The picture.
        stamp_ns: When it was taken, real time [ns].
        frame_id: Frame of the camera.
        quality: Of the JPEG, 1 to 100.
    """
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise MessageError(f"expected uint8 pixels [H, W, 3], got {rgb.dtype} {list(rgb.shape)}")
    if not 1 <= quality <= 100:
        raise MessageError(f"expected a JPEG quality of 1 to 100, got {quality}")
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise MessageError(f"cannot compress a picture of {rgb.shape[1]} x {rgb.shape[0]}")
    return types.CompressedImage(header=header(stamp_ns, frame_id), format=_FORMAT, data=data.reshape(-1))


def raw_image(message: Any) -> Any:
    """``sensor_msgs/Image`` of a picture however it came, with its own stamp; an ``Image`` is returned as it is."""
    if type_name(message) != _COMPRESSED_TYPE:
        return message
    return image_message(_decoded(message), stamp_ns(message), message.header.frame_id)


def picture_array(message: Any) -> NDArray[np.uint8]:
    """Pixels of an ``Image`` (see `image_array`) or of a ``CompressedImage``, then RGB ``[H, W, 3]``."""
    return _decoded(message) if type_name(message) == _COMPRESSED_TYPE else image_array(message)


def _decoded(message: Any) -> NDArray[np.uint8]:
    data = np.asarray(message.data, dtype=np.uint8)
    if "jpeg" not in message.format and "jpg" not in message.format:
        raise MessageError(f"expected a picture compressed as JPEG, got format {message.format[:40]!r}")
    width, height = jpeg_size(data.tobytes())
    if width * height > MAX_PIXELS:
        raise MessageError(f"expected a picture of at most {MAX_PIXELS} pixels, got {width} x {height}")
    bgr = cv2.imdecode(data, cv2.IMREAD_COLOR)
    if bgr is None or bgr.shape[:2] != (height, width):
        raise MessageError(f"expected a JPEG of {width} x {height}, its data are damaged")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Width and height [px] in the header of JPEG data; nothing is decoded.

    Source: ITU-T T.81, annex B: segments of a marker and a length, until the start of frame.
    """
    position = 2 if data.startswith(_START) else len(data)
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF or marker in _BARE:
            position += 1 if marker == 0xFF else 2
            continue
        if marker in _FRAMES:
            return int.from_bytes(data[position + 7 : position + 9], "big"), int.from_bytes(
                data[position + 5 : position + 7], "big"
            )
        if marker == _SCAN:
            break
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    raise MessageError(f"expected JPEG data, got {len(data)} bytes without a size in them")
