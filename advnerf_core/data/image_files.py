"""Image files: read whole or not at all, with their transparency."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.errors import DatasetError
from advnerf_core.files import write_atomically

Rgb = NDArray[np.uint8]
Grey = NDArray[np.uint8]

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
OPAQUE = 255
_ORIENTATION_TAG = 0x0112
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"


def write_image(path: Path, rgb: Rgb) -> None:
    """Write ``[H, W, 3]``, whole or not at all: photographs (``.jpg``) as JPEG of quality 95, anything else without loss."""
    options = [cv2.IMWRITE_JPEG_QUALITY, 95] if path.suffix == ".jpg" else []
    encoded, data = cv2.imencode(path.suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
    if not encoded:
        raise ValueError(f"expected an image that can be written as {path.suffix}, got shape {rgb.shape}")
    write_atomically(path, data.tobytes())


def read_image(path: Path) -> tuple[Rgb, Grey | None]:
    """Colours ``[H, W, 3]`` and, if the file has it, opacity ``[H, W]``; turned upright as its EXIF data says.

    Raises:
        DatasetError: The file cannot be read, is cut off, or is no image.
    """
    data = read_bytes(path)
    # With transparency OpenCV leaves pictures as they lie; only photographs, which have none, are ever turned.
    flags = cv2.IMREAD_COLOR if data.startswith(_JPEG) else cv2.IMREAD_UNCHANGED
    pixels = None if is_cut_off(data) else cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if pixels is None:
        raise DatasetError(
            f"expected a readable image, got {path}: it is damaged or no image, so copy it again"
        )
    if pixels.dtype == np.uint16:
        pixels = np.round(pixels / 257.0).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise DatasetError(
            f"expected an image of 8 or 16 bit, got {path} of {pixels.dtype}; convert it to PNG"
        )
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=-1)
    rgb = np.ascontiguousarray(pixels[..., 2::-1], dtype=np.uint8)
    return rgb, np.ascontiguousarray(pixels[..., 3], dtype=np.uint8) if pixels.shape[2] == 4 else None


def read_mask(path: Path) -> Grey:
    """A mask ``[H, W]``; what is not black is kept."""
    data = read_bytes(path)
    pixels = None if is_cut_off(data) else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    if pixels is None:
        raise DatasetError(
            f"expected a readable mask, got {path}: it is damaged or no image, so make it again"
        )
    return np.asarray(pixels, np.uint8)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height [px] as `read_image` would return them; of a PNG without decoding it."""
    with _open(path) as stream:
        head = stream.read(24)
    if head.startswith(_PNG) and len(head) == 24:
        width, height = struct.unpack(">II", head[16:24])
        return int(width), int(height)
    rgb, _ = read_image(path)
    return rgb.shape[1], rgb.shape[0]


def is_cut_off(data: bytes) -> bool:
    """Whether a JPEG or PNG lacks its end: decoders would fill up the rest of the picture with grey."""
    if data.startswith(_JPEG):
        scan = _first_scan(data)
        return scan is None or data.find(b"\xff\xd9", scan) < 0
    if data.startswith(_PNG):
        return b"IEND" not in data
    return False


def read_bytes(path: Path) -> bytes:
    """The file's content; what stands in the way is one error."""
    with _open(path) as stream:
        return stream.read()


def upright_exif(data: bytes) -> bytes:
    """The EXIF segment of a JPEG file for a copy whose pixels were turned upright: the orientation in it is 1; empty without EXIF."""
    at = 2
    while data.startswith(_JPEG) and at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            return data[at : at + 10] + _with_orientation_1(data[at + 10 : end])
        at = end
    return b""


def _with_orientation_1(tiff: bytes) -> bytes:
    order, changed = "<" if tiff[:2] == b"II" else ">", bytearray(tiff)
    try:
        (directory,) = struct.unpack_from(f"{order}I", tiff, 4)
        (entries,) = struct.unpack_from(f"{order}H", tiff, directory)
        for at in range(directory + 2, directory + 2 + 12 * entries, 12):
            if struct.unpack_from(f"{order}H", tiff, at)[0] == _ORIENTATION_TAG:
                struct.pack_into(f"{order}H", changed, at + 8, 1)
    except struct.error:
        return tiff  # damaged: readers ignore it
    return bytes(changed)


def _first_scan(data: bytes) -> int | None:
    """Where the picture's own data begins; a thumbnail with an end of its own may lie before it."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xDA:
            return at
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


def _open(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise DatasetError(f"expected a readable image, got {path}: {error.strerror}") from error
