"""Checks and metadata of encoded pictures: whether they are whole, their orientation, and the meaning of their alpha."""

from __future__ import annotations

import importlib.util
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

JPEG, PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
# The major brands of HEIF files that hold pictures compressed as H.265.
_HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
_ORIENTATION, _EXTRA_SAMPLES = 0x0112, 0x0152
_ASSOCIATED, _UNASSOCIATED = 1, 2
_AS_STORED = 1
_FULLY_ZERO = bytes(512)


def is_heif(data: bytes) -> bool:
    """Whether this is a HEIC or HEIF picture, as from iPhones."""
    return data[4:8] == b"ftyp" and data[8:12] in _HEIF_BRANDS


def is_tiff(data: bytes) -> bool:
    """Whether this is a TIFF file."""
    return data[:4] in (b"II*\0", b"MM\0*")


def is_damaged(data: bytes) -> bool:
    """Whether a JPEG or PNG lacks its end, or a part that decoders would silently fill in; other formats fail in decoding."""
    if data.startswith(JPEG):
        scan = _first_scan(data)
        return scan is None or data.find(b"\xff\xd9", scan) < 0 or _has_a_hole(data, scan)
    if data.startswith(PNG):
        chunks = list(_png_chunks(data))
        return not chunks or chunks[-1][0] != b"IEND" or not all(whole for _, _, whole in chunks)
    return False


def orientation(data: bytes) -> int:
    """EXIF's orientation, 1 to 8, which says how to turn the picture upright; 1 without one."""
    tiff = _exif(data)
    at = _tag(tiff, _ORIENTATION)
    value = _AS_STORED if at is None else _short(tiff, at)
    return value if 1 <= value <= 8 else _AS_STORED


def turned(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Turn pixels ``[H, W, ...]`` by EXIF's orientation (TIFF 6.0, tag 274)."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def upright_exif(data: bytes) -> bytes:
    """The EXIF segment of a JPEG file for a copy with upright pixels: its orientation is set to 1; empty without EXIF."""
    return exif_segment(_exif(data)) if data.startswith(JPEG) else b""


def exif_segment(tiff: bytes) -> bytes:
    """EXIF data as a segment of a JPEG file with upright pixels; empty without data, or if it is too long for a segment."""
    body = b"Exif\0\0" + _with_value(tiff, _ORIENTATION, _AS_STORED)
    return (
        b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body if tiff and len(body) + 2 < 1 << 16 else b""
    )


def plain_tiff(data: bytes) -> tuple[bytes, str]:
    """A TIFF file whose samples decoders do not change, and the meaning of its fourth one.

    OpenCV always turns TIFF files by their orientation, and multiplies colours by an alpha that is not premultiplied.

    Returns:
        The file without orientation, and ``"associated"`` (colours are multiplied by alpha), ``"unassociated"`` or ``"none"``.
    """
    at = _tag(data, _EXTRA_SAMPLES)
    kind = 0 if at is None else _short(data, at)
    meaning = {_ASSOCIATED: "associated", _UNASSOCIATED: "unassociated"}.get(kind, "none")
    plain = _with_value(data, _ORIENTATION, _AS_STORED)
    return _with_value(plain, _EXTRA_SAMPLES, _ASSOCIATED), meaning


def _exif(data: bytes) -> bytes:
    """The TIFF structure with the EXIF data of a picture; empty without one."""
    if is_tiff(data):
        return data
    if data.startswith(PNG):
        return next((body for name, body, _ in _png_chunks(data) if name == b"eXIf"), b"")
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        found = next((body for name, body in _riff_chunks(data) if name == b"EXIF"), b"")
        return found.removeprefix(b"Exif\0\0")
    at = 2
    while data.startswith(JPEG) and at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            return data[at + 10 : end]
        at = end
    return b""


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes, bool]]:
    """Name and content of each chunk, and whether its checksum is right."""
    at = len(PNG)
    while at + 12 <= len(data):
        length, name = struct.unpack_from(">I4s", data, at)
        body, checksum = data[at + 8 : at + 8 + length], data[at + 8 + length : at + 12 + length]
        yield name, body, checksum == struct.pack(">I", zlib.crc32(name + body))
        if name == b"IEND":
            return
        at += 12 + length


def _riff_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 12
    while at + 8 <= len(data):
        name, length = struct.unpack_from("<4sI", data, at)
        yield name, data[at + 8 : at + 8 + length]
        at += 8 + length + length % 2


def _order(tiff: bytes) -> str:
    return "<" if tiff[:2] == b"II" else ">"


def _tag(tiff: bytes, tag: int) -> int | None:
    """Offset of the value of a tag in the first directory; None without it, or if the directory is damaged, which readers ignore."""
    order = _order(tiff)
    try:
        (directory,) = struct.unpack_from(f"{order}I", tiff, 4)
        (entries,) = struct.unpack_from(f"{order}H", tiff, directory)
        for at in range(directory + 2, directory + 2 + 12 * entries, 12):
            if struct.unpack_from(f"{order}H", tiff, at)[0] == tag and at + 12 <= len(tiff):
                return at + 8
    except struct.error:
        pass
    return None


def _short(tiff: bytes, at: int) -> int:
    return int(struct.unpack_from(f"{_order(tiff)}H", tiff, at)[0])


def _with_value(tiff: bytes, tag: int, value: int) -> bytes:
    at, changed = _tag(tiff, tag), bytearray(tiff)
    if at is not None:
        struct.pack_into(f"{_order(tiff)}H", changed, at, value)
    return bytes(changed)


def _first_scan(data: bytes) -> int | None:
    """Offset of the picture's own data; a thumbnail with its own end marker may precede it."""
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


def _has_a_hole(data: bytes, scan: int) -> bool:
    """Whether coded data are missing or overwritten. OpenCV and Pillow fill the rest with grey; FFmpeg reports it."""
    if importlib.util.find_spec("av") is None:  # an installation for a car only, which learns no scenes
        return False
    import av

    decoder = av.CodecContext.create("mjpeg", "r")
    decoder.options = {"err_detect": "explode"}
    try:
        decoder.decode(av.Packet(data))
        decoder.decode(None)
    except av.error.InvalidDataError:
        return True
    except av.error.FFmpegError:
        return False  # a kind of JPEG that FFmpeg does not support
    return _progressive(data, scan) and _zeros_in_detail(data, scan)


def _progressive(data: bytes, scan: int) -> bool:
    return any(data.find(marker, 2, scan) >= 0 for marker in (b"\xff\xc2\x00\x11", b"\xff\xc2\x00\x0b"))


def _zeros_in_detail(data: bytes, scan: int) -> bool:
    """Whether a scan of detail has a long run of zeros, as lost disk blocks leave: FFmpeg decodes them as valid codes.

    A scan of detail encodes an area without detail in four bytes, however large; only a scan of mean colours may repeat a code for long.
    """
    hole = data.find(_FULLY_ZERO, scan)
    while hole >= 0:
        header = data.rfind(b"\xff\xda", 0, hole)
        first_coefficient = header + 5 + 2 * data[header + 4]
        if data[first_coefficient] > 0:
            return True
        nxt = data.find(b"\xff\xda", hole)
        hole = -1 if nxt < 0 else data.find(_FULLY_ZERO, nxt)
    return False
