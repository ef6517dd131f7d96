"""VESC serial protocol: bytes to values and back, no I/O and no clock.

A frame is ``start, length, payload, CRC, end``. ``start`` is 0x02 with a one-byte length or 0x03 with a two-byte length (payloads
above 255 bytes), the CRC is CRC-16/XMODEM over the payload only, ``end`` is 0x03. All integers are big-endian. The first payload
byte is the command. Facts from the firmware's ``comm/packet.c``, ``comm/commands.c`` and ``datatypes.h`` (tags 1.02 to 7.01).
"""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass
from enum import IntEnum

START_SHORT = 0x02
START_LONG = 0x03
END = 0x03
# Firmware 5.02 and later; 2.18 and 3.40 allowed 1024, which nothing here needs. The lower bound also makes the search after damage
# short: an end byte followed by a short frame (03 02 ..) would otherwise be a long frame of more than 512 bytes to wait for.
MAX_PAYLOAD_BYTES = 512
# CRC and end byte.
_TAIL_BYTES = 3


class CommandId(IntEnum):
    """First payload byte."""

    FW_VERSION = 0
    GET_VALUES = 4
    SET_DUTY = 5
    SET_CURRENT = 6
    SET_CURRENT_BRAKE = 7
    SET_RPM = 8
    SET_SERVO_POS = 12
    SET_APPCONF = 16
    GET_APPCONF = 17
    REBOOT = 29
    ALIVE = 30


# Struct code and units-per-LSB of the one argument of each set command.
_SET_FORMATS: dict[CommandId, tuple[str, float]] = {
    CommandId.SET_DUTY: ("i", 1e5),
    CommandId.SET_CURRENT: ("i", 1e3),
    CommandId.SET_CURRENT_BRAKE: ("i", 1e3),
    CommandId.SET_RPM: ("i", 1.0),
    CommandId.SET_SERVO_POS: ("h", 1e3),
}


@dataclass(frozen=True)
class Command:
    """One decoded host-to-VESC message.

    Attributes:
        id: Command byte; an int without a `CommandId` is a command unknown to this codec.
        value: Argument in SI-like units (duty -1..1, current [A], electrical rpm, servo 0..1), or None.
    """

    id: int
    value: float | None = None

    @property
    def name(self) -> str:
        """Name of the command, or its number."""
        return CommandId(self.id).name if self.id in CommandId._value2member_map_ else f"COMMAND_{self.id}"


def crc16(data: bytes) -> int:
    """CRC-16/XMODEM: polynomial 0x1021, start 0, no reflection; ``crc16(b"123456789") == 0x31C3``."""
    return binascii.crc_hqx(data, 0)


def encode_frame(payload: bytes) -> bytes:
    """Wrap a payload of 1 to `MAX_PAYLOAD_BYTES` bytes into a frame."""
    if not 1 <= len(payload) <= MAX_PAYLOAD_BYTES:
        raise ValueError(f"expected a payload of 1 to {MAX_PAYLOAD_BYTES} bytes, got {len(payload)}")
    short = len(payload) <= 255
    head = struct.pack(">BB" if short else ">BH", START_SHORT if short else START_LONG, len(payload))
    return head + payload + struct.pack(">HB", crc16(payload), END)


class FrameDecoder:
    """Finds frames in a stream of bytes that may be cut, concatenated or damaged.

    A byte sequence that fails a check (start, length, end, CRC) costs one byte, never a whole frame, as in the firmware: the bytes of a
    good frame that follows a damaged one are still in the buffer when the search continues.

    Attributes:
        skipped_bytes: Number of discarded bytes.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.skipped_bytes = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Add received bytes; return the payloads of the frames that are now complete."""
        self._buffer += data
        return self._search(patient=True)

    def give_up(self) -> list[bytes]:
        """Call after silence on the line: the rest of an incomplete frame will not come; returns the frames behind it."""
        return self._search(patient=False)

    @property
    def pending(self) -> bool:
        """Whether bytes wait for the rest of their frame."""
        return bool(self._buffer)

    @property
    def left_over(self) -> int:
        """Number of received bytes outside of whole frames."""
        return self.skipped_bytes + len(self._buffer)

    def _search(self, patient: bool) -> list[bytes]:
        payloads = []
        while self._buffer:
            head = self._head()
            if head is None:
                self._skip()
                continue
            head_bytes, payload_bytes = head
            frame_bytes = head_bytes + payload_bytes + _TAIL_BYTES
            if payload_bytes == 0 or len(self._buffer) < frame_bytes:
                if patient:
                    break  # more bytes are needed to tell
                self._skip()
                continue
            payload = bytes(self._buffer[head_bytes : head_bytes + payload_bytes])
            crc, end = struct.unpack_from(">HB", self._buffer, head_bytes + payload_bytes)
            if end != END or crc != crc16(payload):
                self._skip()
                continue
            del self._buffer[:frame_bytes]
            payloads.append(payload)
        return payloads

    def _skip(self) -> None:
        del self._buffer[0]
        self.skipped_bytes += 1

    def _head(self) -> tuple[int, int] | None:
        """Bytes of head and of payload; (head, 0) if the length has not arrived; None if no frame starts here."""
        start = self._buffer[0]
        head_bytes = {START_SHORT: 2, START_LONG: 3}.get(start)
        if head_bytes is None:
            return None
        if len(self._buffer) < head_bytes:
            return head_bytes, 0
        length = int.from_bytes(self._buffer[1:head_bytes], "big")
        # The long form of a short length is refused by the firmware too; 255 is accepted though never sent.
        smallest = 1 if start == START_SHORT else 255
        return (head_bytes, length) if smallest <= length <= MAX_PAYLOAD_BYTES else None


def encode_command(command: CommandId, value: float | None = None) -> bytes:
    """Frame of a command. ``value`` is in units (duty, ampere, electrical rpm, servo 0..1); it is truncated as in the firmware."""
    if command not in _SET_FORMATS:
        if value is not None:
            raise ValueError(f"expected no value for {command.name}, got {value}")
        return encode_frame(bytes([command]))
    if value is None or value != value or abs(value) == float("inf"):
        raise ValueError(f"expected a finite value for {command.name}, got {value}")
    code, scale = _SET_FORMATS[command]
    try:
        return encode_frame(struct.pack(">B" + code, command, _to_lsb(value, scale)))
    except struct.error:
        raise ValueError(f"expected a value of {command.name} that fits its field, got {value}") from None


def _to_lsb(value: float, scale: float) -> int:
    # (int)(x * scale) truncates toward zero. The tenth of an LSB keeps decimal values such as 0.53 * 1000 = 529.999... whole.
    scaled = value * scale
    nearest = round(scaled)
    return nearest if abs(scaled - nearest) < 1e-6 * max(1.0, abs(scaled)) else int(scaled)


def decode_command(payload: bytes) -> Command | None:
    """Meaning of a payload for a VESC; None when a known command has too few bytes. Surplus bytes are ignored."""
    if not payload:
        return None
    identity = payload[0]
    if identity not in CommandId._value2member_map_ or CommandId(identity) not in _SET_FORMATS:
        return Command(identity)
    code, scale = _SET_FORMATS[CommandId(identity)]
    if len(payload) < 1 + struct.calcsize(">" + code):
        return None
    return Command(identity, struct.unpack_from(">" + code, payload, 1)[0] / scale)


def as_sent(command: CommandId, value: float) -> float:
    """The value that the other end reads after the protocol's truncation."""
    decoded = decode_command(encode_command(command, value)[2:-3])
    assert decoded is not None
    return 0.0 if decoded.value is None else decoded.value
