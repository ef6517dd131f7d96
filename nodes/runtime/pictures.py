"""Convert image messages to RGB, and make JPEG messages that keep the stamp of their image.

Received images are not trusted: the size in the header of compressed data is checked before they are decoded.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nodes.runtime.errors import MessageError
from nodes.runtime.image_encodings import is_bayer, rgb_of_image, rgb_of_samples
from nodes.runtime.image_parts import IMAGE_TYPE
from nodes.runtime.messages import header, image_message, stamp_ns, type_name, types

RAW_TOPIC, COMPRESSED_TOPIC = "/camera/image_raw", "/camera/image_raw/compressed"
COMPRESSED_TYPE = "sensor_msgs/msg/CompressedImage"
# Format text of ROS 2's image transport: the encoding of the image, and the encoding inside the JPEG.
_FORMAT = "rgb8; jpeg compressed bgr8"
_RGB8 = "rgb8"
MAX_PIXELS = 16_000_000
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_SCAN = 0xDA
# Start-of-frame markers hold the size; C4, C8 and CC among them are something else.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_BARE = frozenset({0x01, *range(0xD0, 0xD9)})


def compressed_image_message(rgb: NDArray[np.uint8], stamp_ns: int, frame_id: str, quality: int = 80) -> Any:
    """Make a ``sensor_msgs/CompressedImage`` from pixels ``[H, W, 3]`` uint8.

    Args:
        stamp_ns: Capture time, real time [ns].
        quality: JPEG quality, 1 to 100.
    """
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise MessageError(f"expected uint8 pixels [H, W, 3], got {rgb.dtype} {list(rgb.shape)}")
    if not 1 <= quality <= 100:
        raise MessageError(f"expected a JPEG quality of 1 to 100, got {quality}")
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise MessageError(
            f"cannot compress an image of {rgb.shape[1]} x {rgb.shape[0]} to JPEG; reduce its size"
        )
    return types.CompressedImage(header=header(stamp_ns, frame_id), format=_FORMAT, data=data.reshape(-1))


def rgb_image(message: Any, source: str) -> NDArray[np.uint8]:
    """Convert an ``Image`` or ``CompressedImage`` to RGB pixels ``[H, W, 3]`` uint8, read-only if they are a view of the message.

    Args:
        message: The image, in an encoding of `nodes.runtime.image_encodings`, or JPEG or PNG.
        source: Origin of the image for error messages: its topic and, if read from a bag, the bag.

    Raises:
        MessageError: The message is not an image, is damaged, or has an unsupported encoding.
    """
    typename = type_name(message)
    if typename == COMPRESSED_TYPE:
        return _decompressed(message, source)
    if typename != IMAGE_TYPE:
        raise MessageError(f"{source}: expected {IMAGE_TYPE} or {COMPRESSED_TYPE}, got {typename}")
    return rgb_of_image(message, source)


def rgb8_message(message: Any, source: str) -> Any:
    """Convert an image message to a ``sensor_msgs/Image`` in rgb8 with the same stamp and frame. An rgb8 image is returned as is."""
    rgb = rgb_image(message, source)
    if type_name(message) == IMAGE_TYPE and message.encoding == _RGB8:
        return message
    return image_message(rgb, stamp_ns(message), message.header.frame_id)


def _decompressed(message: Any, source: str) -> NDArray[np.uint8]:
    data = np.asarray(message.data, dtype=np.uint8)
    width, height = _compressed_size(data.tobytes(), str(message.format), source)
    if width * height > MAX_PIXELS:
        raise MessageError(
            f"{source}: expected an image of at most {MAX_PIXELS} pixels, got {width} x {height}"
        )
    try:
        # IMREAD_UNCHANGED keeps 16 bits and single channels, and ignores a rotation in the EXIF data.
        samples = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        samples = None
    if samples is None or samples.shape[:2] != (height, width) or samples.dtype not in (np.uint8, np.uint16):
        raise MessageError(f"{source}: expected a JPEG or PNG image of {width} x {height}, got damaged data")
    return rgb_of_samples(samples.reshape(height, width, -1), _layout(str(message.format), samples))


def _layout(picture_format: str, samples: NDArray[Any]) -> str:
    """Layout of decoded samples. OpenCV returns BGR, but image transport may have compressed another layout as if it were BGR.

    The format reads ``<encoding>; <codec> compressed <layout given to the codec>``. For a colour image the last part is ``bgr8``.
    Without it, image transport uses the order red, green, blue.
    """
    encoding, separator, rest = picture_format.partition(";")
    channels = 1 if samples.ndim == 2 else samples.shape[2]
    if channels == 1:
        return encoding.rstrip("0123456789") if is_bayer(encoding) else "grey"
    swapped = (
        separator
        and "compressed" in rest
        and "compressed bgr" not in rest
        and encoding.startswith(("rgb", "bgr"))
    )
    return {(3, False): "bgr", (3, True): "rgb", (4, False): "bgra", (4, True): "rgba"}[
        channels, bool(swapped)
    ]


def _compressed_size(data: bytes, picture_format: str, source: str) -> tuple[int, int]:
    """Read width and height [px] from the header of JPEG or PNG data without decoding."""
    try:
        if data.startswith(_PNG):
            return png_size(data)
        if data.startswith(_JPEG):
            return jpeg_size(data)
    except MessageError as error:
        raise MessageError(f"{source}: {error}") from None
    raise MessageError(
        f"{source}: expected JPEG or PNG data, got the format {picture_format[:40]!r} ({len(data)} bytes)"
    )


def png_size(data: bytes) -> tuple[int, int]:
    """Read width and height [px] from the header of PNG data without decoding.

    Source: PNG specification, second edition, 11.2.2: the first chunk is IHDR.
    """
    if len(data) < 24 or data[12:16] != b"IHDR":
        raise MessageError(f"expected PNG data, got {len(data)} bytes without an image size")
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Read width and height [px] from the header of JPEG data without decoding.

    Source: ITU-T T.81, annex B: segments of a marker and a length, until the start of frame.
    """
    position = 2 if data.startswith(_JPEG) else len(data)
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
    raise MessageError(f"expected JPEG data, got {len(data)} bytes without an image size")
