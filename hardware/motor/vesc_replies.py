"""Replies of a VESC: firmware version and the seven generations of GET_VALUES, decoded and encoded.

The layouts differ by firmware and carry no version, so the exact payload length selects one. Generation A (firmware up to 3.00) is
no prefix of the later ones, and its length lies between theirs: match exactly, never "at least". Offsets and scales from the
firmware's ``comm/commands.c`` over its tags 1.02 to 7.01.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, fields

from hardware.errors import ProtocolError
from hardware.motor.vesc_codec import CommandId

# Order of the fields on the wire with struct code and LSB per unit. B is the first layout of the modern family; C to G append.
_A: tuple[tuple[str, str, float], ...] = (
    ("temp_mos1_c", "h", 10), ("temp_mos2_c", "h", 10), ("temp_mos3_c", "h", 10), ("temp_mos4_c", "h", 10),
    ("temp_mos5_c", "h", 10), ("temp_mos6_c", "h", 10), ("temp_pcb_c", "h", 10),
    ("motor_current_a", "i", 100), ("input_current_a", "i", 100), ("duty", "h", 1000), ("erpm", "i", 1), ("v_in", "h", 10),
    ("used_ah", "i", 1e4), ("charged_ah", "i", 1e4), ("used_wh", "i", 1e4), ("charged_wh", "i", 1e4),
    ("tachometer", "i", 1), ("tachometer_abs", "i", 1), ("fault", "B", 1),
)  # fmt: skip
_B: tuple[tuple[str, str, float], ...] = (
    ("temp_fet_c", "h", 10), ("temp_motor_c", "h", 10), ("motor_current_a", "i", 100), ("input_current_a", "i", 100),
    ("id_a", "i", 100), ("iq_a", "i", 100), ("duty", "h", 1000), ("erpm", "i", 1), ("v_in", "h", 10),
    ("used_ah", "i", 1e4), ("charged_ah", "i", 1e4), ("used_wh", "i", 1e4), ("charged_wh", "i", 1e4),
    ("tachometer", "i", 1), ("tachometer_abs", "i", 1), ("fault", "B", 1),
)  # fmt: skip
_C = (*_B, ("pid_pos_deg", "i", 1e6))
_D = (*_C, ("controller_id", "B", 1))
_E = (*_D, ("temp_mos1_c", "h", 10), ("temp_mos2_c", "h", 10), ("temp_mos3_c", "h", 10))
_F = (*_E, ("vd_v", "i", 1e3), ("vq_v", "i", 1e3))
_G = (*_F, ("status", "B", 1))
LAYOUTS = {"A": _A, "B": _B, "C": _C, "D": _D, "E": _E, "F": _F, "G": _G}
_FORMATS = {name: ">B" + "".join(code for _, code, _ in layout) for name, layout in LAYOUTS.items()}
_GENERATION_OF_LENGTH = {struct.calcsize(text): name for name, text in _FORMATS.items()}

# mc_fault_code in the firmware's datatypes.h, all 34 values at the head of its repository in 2026; older firmware has fewer.
FAULT_NAMES = {
    0: "none", 1: "over voltage", 2: "under voltage", 3: "gate driver", 4: "over current", 5: "FETs too hot", 6: "motor too hot",
    7: "gate driver over voltage", 8: "gate driver under voltage", 9: "processor under voltage", 10: "booted by its watchdog",
    11: "encoder SPI", 12: "encoder sine/cosine amplitude too small", 13: "encoder sine/cosine amplitude too large",
    14: "flash corrupted", 15: "offset of current sensor 1 too high", 16: "offset of current sensor 2 too high",
    17: "offset of current sensor 3 too high", 18: "phase currents unbalanced", 19: "brake hardware",
    20: "resolver loss of tracking", 21: "resolver degradation of signal", 22: "resolver loss of signal",
    23: "application configuration in flash corrupted", 24: "motor configuration in flash corrupted", 25: "encoder without magnet",
    26: "encoder magnet too strong", 27: "phase filter", 28: "encoder", 29: "low-voltage output", 30: "encoder slipped",
    31: "over speed", 32: "under speed", 33: "over the absolute speed limit",
}  # fmt: skip
OVER_CURRENT = 4  # FAULT_CODE_ABS_OVER_CURRENT of the firmware


@dataclass(frozen=True)
class Values:
    """One GET_VALUES reply. A field that the sender's firmware does not report is None.

    Attributes:
        generation: Layout it came in, ``A`` to ``G``.
        erpm: Electrical revolutions per minute, signed.
        duty: Duty cycle -1..1.
        v_in: Supply voltage [V].
        motor_current_a: Average motor current since the last reading [A]; reading resets the average.
        input_current_a: Average supply current since the last reading [A].
        tachometer: Signed sixth parts of electrical revolutions since power-on.
        fault: Fault code, 0 for none; an unknown code is a fault.
        status: Bit 0: the firmware's command time-out is in force; bit 1: kill switch.
    """

    generation: str
    erpm: float
    duty: float
    v_in: float
    motor_current_a: float
    input_current_a: float
    tachometer: int
    tachometer_abs: int
    fault: int
    used_ah: float
    charged_ah: float
    used_wh: float
    charged_wh: float
    temp_fet_c: float | None = None
    temp_motor_c: float | None = None
    temp_pcb_c: float | None = None
    temp_mos1_c: float | None = None
    temp_mos2_c: float | None = None
    temp_mos3_c: float | None = None
    temp_mos4_c: float | None = None
    temp_mos5_c: float | None = None
    temp_mos6_c: float | None = None
    id_a: float | None = None
    iq_a: float | None = None
    pid_pos_deg: float | None = None
    controller_id: int | None = None
    vd_v: float | None = None
    vq_v: float | None = None
    status: int | None = None

    @property
    def fault_name(self) -> str:
        """Name of the fault code."""
        return FAULT_NAMES.get(self.fault, f"code {self.fault}")

    @property
    def hottest_fet_c(self) -> float | None:
        """Temperature of the hottest MOSFET [degC]: of one sensor, or of firmware up to 3.00 of six; None if none is reported."""
        each = [
            self.temp_fet_c,
            self.temp_mos1_c,
            self.temp_mos2_c,
            self.temp_mos3_c,
            self.temp_mos4_c,
            self.temp_mos5_c,
            self.temp_mos6_c,
        ]
        return max((temperature for temperature in each if temperature is not None), default=None)


_WHOLE = {"tachometer", "tachometer_abs", "fault", "controller_id", "status"}


def decode_values(payload: bytes) -> Values:
    """Decode a GET_VALUES reply; its exact length (54, 56, 58, 59, 65, 73 or 74 bytes) names the layout."""
    generation = _GENERATION_OF_LENGTH.get(len(payload))
    if generation is None or payload[0] != CommandId.GET_VALUES:
        lengths = ", ".join(str(n) for n in sorted(_GENERATION_OF_LENGTH))
        raise ProtocolError(
            f"expected a GET_VALUES reply of {lengths} bytes, got command {payload[:1].hex()} with {len(payload)} bytes;"
            " this firmware's layout is not known: add it to hardware/motor/vesc_replies.py"
        )
    raw = struct.unpack(_FORMATS[generation], payload)[1:]
    items = zip(LAYOUTS[generation], raw, strict=True)
    return Values(
        generation, **{name: value if name in _WHOLE else value / scale for (name, _, scale), value in items}
    )


def encode_values(values: Values) -> bytes:
    """Payload of a GET_VALUES reply in the layout of ``values.generation``; a missing field is sent as 0."""
    layout = LAYOUTS[values.generation]
    raw = [int((getattr(values, name) or 0) * scale) for name, _, scale in layout]
    return struct.pack(_FORMATS[values.generation], CommandId.GET_VALUES, *raw)


@dataclass(frozen=True)
class FirmwareVersion:
    """Identity reported by a VESC. Old firmware reports less.

    Attributes:
        major: First number of the firmware version.
        minor: Second number.
        hardware_name: ``60``, ``410``, ...; ``TWIN`` for the simulated lab; None before firmware 3.40.
        uuid: Twelve bytes that identify the board, or None.
    """

    major: int
    minor: int
    hardware_name: str | None = None
    uuid: bytes | None = None

    def __str__(self) -> str:
        return f"{self.hardware_name or 'VESC'} firmware {self.major}.{self.minor:02d}"


def decode_firmware_version(payload: bytes) -> FirmwareVersion:
    """Decode an FW_VERSION reply, as far as it goes: 3 bytes up to firmware 2.18, then a name, a UUID, and more flags with each version."""
    if len(payload) < 3 or payload[0] != CommandId.FW_VERSION:
        raise ProtocolError(
            f"expected an FW_VERSION reply of at least 3 bytes, got {payload.hex(' ') or 'nothing'}"
        )
    rest = payload[3:]
    if b"\0" not in rest:
        return FirmwareVersion(payload[1], payload[2])
    name, _, rest = rest.partition(b"\0")
    uuid = rest[:12] if len(rest) >= 12 else None
    return FirmwareVersion(payload[1], payload[2], name.decode("ascii", "replace"), uuid)


def encode_firmware_version(version: FirmwareVersion) -> bytes:
    """Payload of an FW_VERSION reply with the fields that this version of the firmware sends."""
    head = struct.pack(">BBB", CommandId.FW_VERSION, version.major, version.minor)
    release = (version.major, version.minor)
    if release < (3, 40) or version.hardware_name is None:
        return head
    payload = head + version.hardware_name.encode("ascii") + b"\0" + (version.uuid or bytes(12))
    payload += b"\0" if release >= (4, 2) else b""  # pairing done
    payload += (
        b"\0\0\0" if release >= (5, 2) else b""
    )  # test version, hardware type VESC, custom configurations
    payload += b"\0\0\0" if release >= (5, 3) else b""  # phase filters, two user interface flags
    payload += b"\0\0" if release >= (6, 0) else b""  # NRF flags, empty firmware name
    return payload


# A layout may name only fields that `Values` has.
assert {name for layout in LAYOUTS.values() for name, _, _ in layout} <= {
    field.name for field in fields(Values)
}
