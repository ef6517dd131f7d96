"""Faults of a serial line that change the bytes from a controller. Pure; the randomness is the caller's."""

from __future__ import annotations

import random

from hardware.motor.vesc_codec import FrameDecoder

WIRE_FAULTS = ("dribble", "noise", "garbage", "bad_crc", "silent")
# A frame's last byte but one: half of its CRC.
_CRC_OFFSET = -2


def wire_chunks(reply: bytes, fault: str | None, rng: random.Random) -> list[bytes]:
    """Pieces in which a reply of whole frames reaches the computer.

    Args:
        reply: One or more frames.
        fault: ``dribble``: byte by byte; ``noise``: random bytes between intact frames; ``garbage``: random bytes instead of
            them, many of them start and end bytes; ``bad_crc``: every frame with a wrong sum; ``silent``: nothing; None: unchanged.
        rng: Source of random bytes.
    """
    if fault is None or not reply:
        return [reply] if reply else []
    if fault == "dribble":
        return [reply[i : i + 1] for i in range(len(reply))]
    if fault == "noise":
        return [_noise(rng), reply, _noise(rng)]
    if fault == "garbage":
        return [_noise(rng, len(reply))]
    if fault == "bad_crc":
        return [_damaged(reply)]
    return []


def require_wire_fault(fault: str | None) -> None:
    """Raise a `ValueError` that names the choices, unless ``fault`` is one of `WIRE_FAULTS` or None."""
    if fault is not None and fault not in WIRE_FAULTS:
        raise ValueError(f"expected a fault of {', '.join(WIRE_FAULTS)}, got {fault!r}")


def _noise(rng: random.Random, length: int | None = None) -> bytes:
    length = rng.randint(1, 40) if length is None else length
    return bytes(rng.choice((2, 3, rng.randrange(256))) for _ in range(length))


def _damaged(reply: bytes) -> bytes:
    damaged = bytearray(reply)
    end = 0
    for payload in FrameDecoder().feed(reply):
        end += len(payload) + (5 if len(payload) <= 255 else 6)
        damaged[end + _CRC_OFFSET] ^= 0xFF
    return bytes(damaged)
