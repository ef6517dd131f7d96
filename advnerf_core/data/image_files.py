"""Image files: read whole or not at all, with their transparency; in stored or upright orientation."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_bytes import (
    JPEG,
    PNG,
    exif_segment,
    is_damaged,
    is_heif,
    is_tiff,
    orientation,
    plain_tiff,
    turned,
)
from advnerf_core.files import write_atomically

Rgb = NDArray[np.uint8]
Grey = NDArray[np.uint8]

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
HEIF_SUFFIXES = (".heic", ".heif")
OPAQUE = 255
JPEG_QUALITY = 95


def write_image(path: Path, rgb: Rgb) -> None:
    """Write ``[H, W, 3]``, whole or not at all: photographs (``.jpg``) as JPEG of quality 95, anything else without loss."""
    write_atomically(path, encoded(rgb, path.suffix))


def encoded(rgb: Rgb, suffix: str, alpha: Grey | None = None) -> bytes:
    """The content that `write_image` writes for this suffix; with opacity ``[H, W]`` if the format has it.

    Raises:
        DatasetError: No format of pictures has this suffix.
    """
    if not cv2.haveImageWriter(f"picture{suffix}"):
        raise DatasetError(
            f"expected the name of a picture to write ({', '.join(SUFFIXES)}), got one that ends in {suffix!r}; choose another name"
        )
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if suffix in (".jpg", ".jpeg") else []
    planes = [rgb[..., ::-1]] if alpha is None or suffix in (".jpg", ".jpeg") else [rgb[..., ::-1], alpha]
    done, data = cv2.imencode(suffix, np.ascontiguousarray(np.dstack(planes)), options)
    if not done:
        raise ValueError(f"expected an image that can be written as {suffix}, got shape {rgb.shape}")
    return data.tobytes()


def decode_stored(data: bytes, source: str) -> Rgb:
    """Colours ``[H, W, 3]`` of the content of an image file, as `read_stored` reads it; errors call it ``source``."""
    return _decoded(Path(source), data)[0]


def read_stored(path: Path) -> tuple[Rgb, Grey | None]:
    """Colours ``[H, W, 3]`` and, if the file has it, opacity ``[H, W]``, of the pixels in stored orientation.

    Images with poses, masks, logs and calibration pictures are read this way: their numbers refer to the stored pixels, regardless
    of EXIF's orientation.

    Raises:
        DatasetError: The file cannot be read, is damaged, or is not an image.
    """
    return _decoded(path, read_bytes(path))


def read_upright(path: Path) -> tuple[Rgb, Grey | None]:
    """The same for a picture for people, or one whose pose is still unknown: turned upright by its EXIF data."""
    data = read_bytes(path)
    rgb, alpha = _decoded(path, data)
    turn = 1 if is_heif(data) else orientation(data)  # the decoder of HEIF has turned it already
    return turned(rgb, turn), None if alpha is None else turned(alpha, turn)


def read_mask(path: Path) -> Grey:
    """A mask ``[H, W]`` of stored pixels; pixels that are neither black nor fully transparent are kept."""
    try:
        rgb, alpha = read_stored(path)
    except DatasetError as error:
        raise DatasetError(f"mask: {error}") from error
    grey = np.asarray(rgb.max(axis=-1), np.uint8)
    return grey if alpha is None else np.minimum(grey, alpha)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height [px] that `read_stored` would return; for a PNG without decoding it."""
    with _open(path) as stream:
        head = stream.read(24)
    return size_of(head if head.startswith(PNG) else read_bytes(path), str(path))


def size_of(data: bytes, source: str) -> tuple[int, int]:
    """The same of the content of an image file; errors call it ``source``."""
    if data.startswith(PNG) and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return int(width), int(height)
    rgb = decode_stored(data, source)
    return rgb.shape[1], rgb.shape[0]


def read_bytes(path: Path) -> bytes:
    """The file's content; failures are raised as one kind of error."""
    with _open(path) as stream:
        return stream.read()


def _decoded(path: Path, data: bytes) -> tuple[Rgb, Grey | None]:
    if is_heif(data):
        return _decoded_heif(path, data), None
    meaning = "unassociated"
    whole = bool(data) and not is_damaged(data)
    if is_tiff(data):
        data, meaning = plain_tiff(data)
    pixels = _opencv_pixels(data) if whole else None
    if pixels is None:
        raise DatasetError(
            f"expected a readable image, got {path} ({len(data)} bytes): it is damaged or no image, so copy it again"
        )
    if pixels.dtype == np.uint16:
        pixels = np.round(np.asarray(pixels, np.float64) / 257.0).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise DatasetError(
            f"expected an image of 8 or 16 bit, got {path} of {pixels.dtype}; convert it to PNG"
        )
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=-1)
    rgb = np.ascontiguousarray(pixels[..., 2::-1], dtype=np.uint8)
    if pixels.shape[2] != 4 or meaning == "none":
        return rgb, None
    alpha = np.ascontiguousarray(pixels[..., 3], dtype=np.uint8)
    return (unpremultiplied(rgb, alpha) if meaning == "associated" else rgb), alpha


def _opencv_pixels(data: bytes) -> NDArray[Any] | None:
    # Colours of a JPEG may be CMYK, which only the first flag converts; the second reads all others, alpha and 16 bit.
    flags = (
        cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION if data.startswith(JPEG) else cv2.IMREAD_UNCHANGED
    )
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        return None


def heif_exif(path: Path, data: bytes) -> bytes:
    """The EXIF data of a HEIC picture as a segment for an upright JPEG copy; empty without any."""
    return exif_segment(_heif_image(path, data).getexif().tobytes().removeprefix(b"Exif\0\0"))


def _decoded_heif(path: Path, data: bytes) -> Rgb:
    return np.ascontiguousarray(np.asarray(_heif_image(path, data).convert("RGB")), dtype=np.uint8)


def heif_reader(path: Path) -> Any:
    """The library that reads HEIC pictures.

    Raises:
        DatasetError: The library is not installed.
    """
    try:
        import pillow_heif
    except ImportError:
        raise DatasetError(
            f"expected pillow-heif to read {path} (HEIC, as iPhones take pictures), it is not installed; run: "
            "pip install pillow-heif, or convert the pictures to JPEG"
        ) from None
    return pillow_heif


def _heif_image(path: Path, data: bytes) -> Any:
    """A HEIC picture as an upright PIL image."""
    reader = heif_reader(path)
    try:
        return reader.open_heif(data, convert_hdr_to_8bit=True).to_pillow()
    except (ValueError, OSError, EOFError, RuntimeError) as error:
        raise DatasetError(
            f"expected a readable image, got {path} ({len(data)} bytes): it is damaged or no image ({error}), so copy it again"
        ) from error


def unpremultiplied(rgb: Rgb, alpha: Grey) -> Rgb:
    """Colours without the opacity that they were multiplied by."""
    weight = np.maximum(alpha[..., None], 1) / np.float32(OPAQUE)
    return np.minimum(np.rint(rgb / weight), OPAQUE).astype(np.uint8)


def _open(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise DatasetError(f"expected a readable image, got {path}: {error.strerror}") from error
