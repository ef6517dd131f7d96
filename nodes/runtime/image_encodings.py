"""Convert the pixel encodings of ``sensor_msgs/Image`` to RGB with 8 bits per channel.

The message leaves three conventions open. They are fixed here:

- ``8UC1``, ``8UC3`` and ``8UC4`` name a layout without colours. They are read in OpenCV's order: grey, BGR and BGRA.
- 16-bit values are converted to 8 bits by rounding ``value / 257``, so that 65535 becomes 255. Alpha is dropped.
- ROS names a Bayer pattern by the four pixels of its top left corner. OpenCV's older constants name it by the second and third
  pixel of the second row, so ``bayer_rggb8`` is its ``BayerBG``. The aliases used here carry the name of the corner.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nodes.runtime.errors import MessageError

# Channels by name; the number of bits follows it.
_GREY, _RGB, _BGR, _RGBA, _BGRA = "grey", "rgb", "bgr", "rgba", "bgra"
_CHANNELS = {_GREY: 1, _RGB: 3, _BGR: 3, _RGBA: 4, _BGRA: 4}
_DEMOSAIC = {
    "bayer_rggb": cv2.COLOR_BayerRGGB2RGB, "bayer_bggr": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg": cv2.COLOR_BayerGBRG2RGB, "bayer_grbg": cv2.COLOR_BayerGRBG2RGB,
}  # fmt: skip
# Two pixels share their colour: four bytes for them.
_PAIRS = {
    "uyvy": cv2.COLOR_YUV2RGB_UYVY, "yuv422": cv2.COLOR_YUV2RGB_UYVY,
    "yuyv": cv2.COLOR_YUV2RGB_YUY2, "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
}  # fmt: skip
# Four pixels share their colour: the grey picture, then half as many rows of colours.
_PLANES = {"nv12": cv2.COLOR_YUV2RGB_NV12, "nv21": cv2.COLOR_YUV2RGB_NV21}
# Layout and bits of the encodings that hold one sample after the other.
_SAMPLES: dict[str, tuple[str, int]] = {
    **{f"{layout}{bits}": (layout, bits) for layout in (_RGB, _BGR, _RGBA, _BGRA, *_DEMOSAIC) for bits in (8, 16)},
    "mono8": (_GREY, 8), "mono16": (_GREY, 16), "8UC1": (_GREY, 8), "8UC3": (_BGR, 8), "8UC4": (_BGRA, 8),
}  # fmt: skip
ENCODINGS = (*_SAMPLES, *_PAIRS, *_PLANES)


def rgb_of_image(message: Any, source: str) -> NDArray[np.uint8]:
    """Convert a ``sensor_msgs/Image`` to RGB pixels ``[H, W, 3]`` uint8. For ``rgb8`` without padding, they are a view of the message.

    Args:
        message: The image, in one of `ENCODINGS`.
        source: Origin of the image for error messages: its topic and, if read from a bag, the bag.

    Raises:
        MessageError: The encoding is not supported, or the data do not fit it.
    """
    encoding = str(message.encoding)
    if encoding not in ENCODINGS:
        raise MessageError(
            f"{source}: expected a supported image encoding, got {encoding[:40]!r}; supported are {', '.join(ENCODINGS)}"
        )
    try:
        if encoding in _PLANES:
            rows = _rows(message, source, 1, planes=True)
            return np.asarray(cv2.cvtColor(rows, _PLANES[encoding]), np.uint8)
        if encoding in _PAIRS:
            rows = _rows(message, source, 2, even=True)
            return np.asarray(cv2.cvtColor(rows.reshape(*rows.shape[:1], -1, 2), _PAIRS[encoding]), np.uint8)
        layout, bits = _SAMPLES[encoding]
        rows = _rows(message, source, _CHANNELS.get(layout, 1) * bits // 8)
        if bits == 16:
            rows = rows.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
        return rgb_of_samples(rows.reshape(message.height, message.width, -1), layout)
    except cv2.error as error:
        raise MessageError(
            f"{source}: cannot convert an image of {message.width} x {message.height} in {encoding} to RGB: {error.err}"
        ) from error


def rgb_of_samples(samples: NDArray[Any], layout: str) -> NDArray[np.uint8]:
    """Convert samples ``[H, W, C]``, uint8 or uint16, to RGB ``[H, W, 3]`` uint8.

    Args:
        layout: ``grey``, ``rgb``, ``bgr``, ``rgba``, ``bgra``, or a Bayer pattern such as ``bayer_rggb``.
    """
    if layout in _DEMOSAIC:
        return _eight_bits(cv2.cvtColor(samples[..., 0], _DEMOSAIC[layout]))
    samples = _eight_bits(samples)
    if layout == _GREY:
        return np.repeat(samples, 3, axis=2)
    rgb = samples[..., 2::-1] if layout in (_BGR, _BGRA) else samples[..., :3]
    return rgb if layout == _RGB else np.ascontiguousarray(rgb)


def is_bayer(encoding: str) -> bool:
    """Whether an encoding is a Bayer pattern, with or without its number of bits."""
    return encoding.rstrip("0123456789") in _DEMOSAIC


def _eight_bits(samples: NDArray[Any]) -> NDArray[np.uint8]:
    if samples.dtype != np.uint16:
        return np.asarray(samples, np.uint8)
    return ((samples.astype(np.uint32) + 128) // 257).astype(np.uint8)


def _rows(
    message: Any, source: str, pixel_bytes: int, even: bool = False, planes: bool = False
) -> NDArray[np.uint8]:
    """Rows of an image without padding, ``[H, W * pixel_bytes]``. With ``planes``, half as many rows follow."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    count = height * 3 // 2 if planes else height
    row_bytes = width * pixel_bytes
    if height < 1 or width < 1 or step < row_bytes or len(message.data) != count * step:
        raise MessageError(
            f"{source}: expected {count} rows of {step} >= {row_bytes} bytes for {width} x {height} {message.encoding}, "
            f"got {len(message.data)} bytes"
        )
    if ((even or planes) and width % 2) or (planes and height % 2):
        raise MessageError(
            f"{source}: expected an even size for {message.encoding}, whose pixels share colours; got {width} x {height}"
        )
    rows = np.asarray(message.data, dtype=np.uint8).reshape(count, step)
    return rows if step == row_bytes else np.ascontiguousarray(rows[:, :row_bytes])
