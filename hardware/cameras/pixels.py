"""Converts the bytes of a video buffer to RGB, for the pixel formats of cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class PixelLayout:
    """Memory layout of an image, as confirmed by the driver.

    Attributes:
        pixel_format: Four letters, for example ``YUYV``.
        width: Width [px].
        height: Height [px].
        bytes_per_line: Offset from one row to the next [bytes]; 0 for compressed formats.
        columns: First and one past the last column to deliver, because the images of a stereo camera are side by side.
    """

    pixel_format: str
    width: int
    height: int
    bytes_per_line: int
    columns: tuple[int, int]

    @property
    def size_bytes(self) -> int:
        """Size of a complete image [bytes]; 1 for compressed formats."""
        rows = self.height + self.height // 2 if self.pixel_format == "NV12" else self.height
        return max(rows * self.bytes_per_line, 1)


def _coloured(pixels: Bytes, code: int) -> Bytes:
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), code), dtype=np.uint8)


def _packed_yuv(code: int) -> Callable[[Bytes, PixelLayout], Bytes]:
    def convert(data: Bytes, layout: PixelLayout) -> Bytes:
        pixels = _rows(data, layout, layout.height)[:, : 2 * layout.width].reshape(
            layout.height, layout.width, 2
        )
        return _coloured(pixels[:, slice(*layout.columns)], code)

    return convert


def _packed_three(swap: bool) -> Callable[[Bytes, PixelLayout], Bytes]:
    def convert(data: Bytes, layout: PixelLayout) -> Bytes:
        pixels = _rows(data, layout, layout.height)[:, : 3 * layout.width].reshape(
            layout.height, layout.width, 3
        )
        part = pixels[:, slice(*layout.columns)]
        return np.array(part[:, :, ::-1] if swap else part, order="C")

    return convert


def _grey(data: Bytes, layout: PixelLayout) -> Bytes:
    part = _rows(data, layout, layout.height)[:, slice(*layout.columns)]
    return _coloured(part, cv2.COLOR_GRAY2RGB)


def _nv12(data: Bytes, layout: PixelLayout) -> Bytes:
    rows = _rows(data, layout, layout.height * 3 // 2)[:, slice(*layout.columns)]
    return _coloured(rows, cv2.COLOR_YUV2RGB_NV12)


def _jpeg(data: Bytes, layout: PixelLayout) -> Bytes:
    bgr = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if bgr is None:
        raise ValueError("the JPEG data of a frame are damaged")
    if bgr.shape[:2] != (layout.height, layout.width):
        raise ValueError(
            f"expected {layout.width} x {layout.height}, got a JPEG of {bgr.shape[1]} x {bgr.shape[0]}"
        )
    return np.ascontiguousarray(bgr[:, slice(*layout.columns), ::-1])


# YUV is interpreted as BT.601 with limited range, which USB cameras send.
_CONVERT: dict[str, Callable[[Bytes, PixelLayout], Bytes]] = {
    "YUYV": _packed_yuv(cv2.COLOR_YUV2RGB_YUYV),
    "UYVY": _packed_yuv(cv2.COLOR_YUV2RGB_UYVY),
    "YVYU": _packed_yuv(cv2.COLOR_YUV2RGB_YVYU),
    "NV12": _nv12,
    "RGB3": _packed_three(swap=False),
    "BGR3": _packed_three(swap=True),
    "GREY": _grey,
    "MJPG": _jpeg,
    "JPEG": _jpeg,
}
PIXEL_FORMATS = tuple(_CONVERT)
COMPRESSED = ("MJPG", "JPEG")
_BYTES_PER_PIXEL = {"NV12": 1, "GREY": 1, "RGB3": 3, "BGR3": 3}


def least_bytes_per_line(pixel_format: str, width: int) -> int:
    """Size of a row without padding [bytes]; 0 for compressed formats."""
    return 0 if pixel_format in COMPRESSED else width * _BYTES_PER_PIXEL.get(pixel_format, 2)


def to_rgb(data: Bytes, layout: PixelLayout) -> Bytes:
    """Convert an image to newly allocated pixels ``[H, W, 3]``. Raises `ValueError` for invalid bytes."""
    if data.size < layout.size_bytes:
        raise ValueError(f"expected {layout.size_bytes} bytes, got {data.size}; the frame is truncated")
    rgb = _CONVERT[layout.pixel_format](data, layout)
    rgb.flags.writeable = False
    return rgb


def _rows(data: Bytes, layout: PixelLayout, rows: int) -> Bytes:
    return data[: rows * layout.bytes_per_line].reshape(rows, layout.bytes_per_line)
