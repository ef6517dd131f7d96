"""Parses the EDID of a monitor, above all its size in pixels and in millimetres.

128 bytes (VESA E-EDID 1.4, section 3); extension blocks are not needed here. The size in centimetres at bytes 21 and 22 is too
coarse for an attack of known size; the preferred timing at byte 54 gives millimetres. Some monitors write an aspect ratio or
nonsense there, so the two are compared and a contradiction is no size at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hardware.errors import DeviceNotFound, ProtocolError

BLOCK_BYTES = 128
DRM_FOLDER = Path("/sys/class/drm")
_HEADER = bytes.fromhex("00ffffffffffff00")
_DESCRIPTORS = (54, 72, 90, 108)
_DESCRIPTOR_BYTES = 18
_NAME_TAG = 0xFC
# Centimetres are rounded, by some makers up and by others down.
_COARSE_MM = 10.0
_FULL_TURN = 256


@dataclass(frozen=True)
class Edid:
    """The used fields of an EDID.

    Attributes:
        maker: Three letters of the manufacturer.
        product: Product code.
        name: Name of the monitor; empty if it does not say.
        size_px: Width and height of the preferred mode, which on a flat panel is the native one [px].
        size_mm: Width and height of the picture [mm]; None if the monitor does not say or contradicts itself.
    """

    maker: str
    product: int
    name: str
    size_px: tuple[int, int]
    size_mm: tuple[float, float] | None


def parse_edid(data: bytes) -> Edid:
    """Read an EDID.

    Raises:
        ProtocolError: The bytes are not an EDID, are damaged, or name no preferred mode.
    """
    if len(data) < BLOCK_BYTES or data[:8] != _HEADER:
        raise ProtocolError(
            f"expected an EDID of 128 bytes that begins with {_HEADER.hex()}, got {data[:8].hex()!r}"
        )
    block = data[:BLOCK_BYTES]
    if rest := sum(block) % _FULL_TURN:
        raise ProtocolError(
            f"expected an EDID whose bytes add up to 0, got {rest}; it was damaged in transit (check adapter and cable)"
        )
    timing = block[54:72]
    if timing[:2] == b"\0\0":
        raise ProtocolError(
            "expected a preferred mode in the EDID, got none; give the size in pixels instead"
        )
    width_px, height_px = timing[2] | (timing[4] & 0xF0) << 4, timing[5] | (timing[7] & 0xF0) << 4
    if width_px == 0 or height_px == 0:
        raise ProtocolError(
            f"expected a preferred mode with pixels in the EDID, got {width_px} x {height_px}"
        )
    fine = (float(timing[12] | (timing[14] & 0xF0) << 4), float(timing[13] | (timing[14] & 0x0F) << 8))
    coarse = (10.0 * block[21], 10.0 * block[22])
    return Edid(
        _maker(block), block[10] | block[11] << 8, _name(block), (width_px, height_px), _size(fine, coarse)
    )


def make_edid(
    maker: str, product: int, name: str, size_px: tuple[int, int], size_mm: tuple[int, int]
) -> bytes:
    """EDID of a simulated monitor (the twin's): the fields that `parse_edid` reads, 60 Hz, version 1.4."""
    block = bytearray(BLOCK_BYTES)
    block[:8] = _HEADER
    block[8:10] = sum(
        (ord(letter) - 64) << shift for letter, shift in zip(maker, (10, 5, 0), strict=True)
    ).to_bytes(2, "big")
    block[10:12] = product.to_bytes(2, "little")
    block[17:20] = bytes((36, 1, 4))  # made in 2026
    block[20:23] = bytes((0xA5, round(size_mm[0] / 10), round(size_mm[1] / 10)))
    width, height = size_px
    clock_10khz = round((width + 160) * (height + 40) * 60 / 1e4)
    timing = bytearray(_DESCRIPTOR_BYTES)
    timing[:2] = clock_10khz.to_bytes(2, "little")
    timing[2:5] = bytes((width & 0xFF, 160, width >> 8 << 4))
    timing[5:8] = bytes((height & 0xFF, 40, height >> 8 << 4))
    timing[12:15] = bytes((size_mm[0] & 0xFF, size_mm[1] & 0xFF, size_mm[0] >> 8 << 4 | size_mm[1] >> 8))
    block[54:72] = timing
    block[72:90] = bytes((0, 0, 0, _NAME_TAG, 0)) + (name.encode("ascii") + b"\n").ljust(13)[:13]
    block[93], block[111] = 0x10, 0x10  # the other two descriptors are dummies
    block[127] = -sum(block) % _FULL_TURN
    return bytes(block)


def connected_displays(folder: Path = DRM_FOLDER) -> dict[str, Edid]:
    """Connected monitors in the kernel's list, by connector (``HDMI-A-1``); one whose EDID cannot be read is left out."""
    found = {}
    for file in sorted(folder.glob("card*-*/edid")):
        try:
            data = file.read_bytes()
            if data:  # the file is empty if nothing is plugged in
                found[file.parent.name.split("-", 1)[1]] = parse_edid(data)
        except (OSError, ProtocolError):
            continue
    return found


def edid_of(connector: str, folder: Path = DRM_FOLDER) -> Edid:
    """EDID of the monitor at a connector.

    Raises:
        DeviceNotFound: Nothing is connected there.
    """
    found = connected_displays(folder)
    if connector not in found:
        there = ", ".join(f"{name} ({edid.name or edid.maker})" for name, edid in found.items()) or "none"
        raise DeviceNotFound(f"expected a monitor at connector {connector}, found: {there}")
    return found[connector]


def _maker(block: bytes) -> str:
    code = block[8] << 8 | block[9]
    return "".join(chr(64 + (code >> shift & 0x1F)) for shift in (10, 5, 0))


def _name(block: bytes) -> str:
    for start in _DESCRIPTORS:
        descriptor = block[start : start + _DESCRIPTOR_BYTES]
        if descriptor[:3] == b"\0\0\0" and descriptor[3] == _NAME_TAG:
            return descriptor[5:].split(b"\n")[0].decode("ascii", "replace").strip()
    return ""


def _size(fine: tuple[float, float], coarse: tuple[float, float]) -> tuple[float, float] | None:
    if 0.0 in fine or 0.0 in coarse:  # a projector has no size
        return None
    agree = all(abs(f - c) <= _COARSE_MM for f, c in zip(fine, coarse, strict=True))
    return fine if agree else None
