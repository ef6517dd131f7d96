"""The two settings of a VESC that decide how far a car rolls after its computer has failed: command time-out and brake current.

They lie at the head of the controller's application configuration, which is read as a whole, changed in eight bytes and written
back as a whole: everything behind them differs between firmware versions and is not changed. Three heads are known (firmware
sources ``commands.c`` of 2.x, 3.x and 4.0x, ``confgenerator.c`` of 5.x and later); none of them names itself:

- ``scaled`` (before 3.07): controller id u8, time-out u32 [ms], brake current i32 [mA];
- ``plain`` (3.07 to 4.x): controller id u8, time-out u32 [ms], brake current f32 [A];
- ``signed`` (later): a signature u32 over the layout, then as ``plain``.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from hardware.errors import ProtocolError
from hardware.motor.vesc_codec import CommandId, encode_frame
from hardware.motor.vesc_replies import FirmwareVersion

_HEADS = {"scaled": struct.Struct(">BIi"), "plain": struct.Struct(">BIf"), "signed": struct.Struct(">IBIf")}
_FIRST_PLAIN = (3, 7)
# Beyond these a number is no plausible setting, and the layout is another one.
_LONGEST_MS, _LARGEST_A, _SMALLEST_A = 600_000, 200.0, 1e-3


@dataclass(frozen=True)
class TimeoutSettings:
    """Behaviour of the controller when commands stop.

    Attributes:
        timeout_ms: Time without a motor command after which it takes over [ms]; 0: never.
        brake_current_a: Brake current then [A]; 0: the car coasts.
    """

    timeout_ms: int
    brake_current_a: float

    def __post_init__(self) -> None:
        if not (0 <= self.timeout_ms <= _LONGEST_MS and 0.0 <= self.brake_current_a <= _LARGEST_A):
            raise ValueError(
                f"expected a time-out of 0 to {_LONGEST_MS} ms and a brake current of 0 to {_LARGEST_A:g} A, got"
                f" {self.timeout_ms} ms and {self.brake_current_a} A"
            )

    def __str__(self) -> str:
        return f"{self.timeout_ms} ms with {self.brake_current_a:g} A" if self.timeout_ms else "switched off"

    def at_least(self, other: TimeoutSettings) -> bool:
        """Whether these settings stop a car as early and as hard as others."""
        return (
            0 < self.timeout_ms <= other.timeout_ms and self.brake_current_a >= other.brake_current_a - 1e-3
        )


@dataclass(frozen=True)
class AppConfiguration:
    """A controller's application configuration.

    Attributes:
        data: The bytes after the command id.
        layout: Layout of its head: ``scaled``, ``plain`` or ``signed``.
    """

    data: bytes
    layout: str

    @property
    def timeout(self) -> TimeoutSettings:
        """The settings in the head."""
        *_, timeout_ms, brake = _HEADS[self.layout].unpack_from(self.data)
        return TimeoutSettings(timeout_ms, brake / 1000.0 if self.layout == "scaled" else brake)

    def with_timeout(self, settings: TimeoutSettings) -> AppConfiguration:
        """The same configuration with other settings; no other byte changes."""
        head = _HEADS[self.layout]
        *kept, _, _ = head.unpack_from(self.data)
        brake = (
            round(settings.brake_current_a * 1000) if self.layout == "scaled" else settings.brake_current_a
        )
        return AppConfiguration(
            head.pack(*kept, settings.timeout_ms, brake) + self.data[head.size :], self.layout
        )

    def encode_set(self) -> bytes:
        """Frame that sends and stores this configuration in the controller."""
        return encode_frame(bytes([CommandId.SET_APPCONF]) + self.data)


@dataclass(frozen=True)
class Stored:
    """Reply to SET_APPCONF: the controller took a configuration and keeps it."""


def decode_app_configuration(payload: bytes, firmware: FirmwareVersion) -> AppConfiguration:
    """Read the reply to GET_APPCONF.

    Raises:
        ProtocolError: No known head, or more than one, gives plausible settings.
    """
    if not payload or payload[0] != CommandId.GET_APPCONF:
        raise ProtocolError(f"expected a GET_APPCONF reply, got {payload[:1].hex() or 'nothing'}")
    data = payload[1:]
    old = (firmware.major, firmware.minor) < _FIRST_PLAIN
    layouts = [name for name in (("scaled",) if old else ("plain", "signed")) if _plausible(data, name)]
    if len(layouts) != 1:
        raise ProtocolError(
            f"expected the time-out at the head of the configuration of {firmware}, got {len(data)} bytes"
            f" {data[:12].hex(' ')} ...: read and set it in VESC Tool"
        )
    return AppConfiguration(data, layouts[0])


def _plausible(data: bytes, layout: str) -> bool:
    head = _HEADS[layout]
    if len(data) < head.size:
        return False
    *_, timeout_ms, brake = head.unpack_from(data)
    amperes = brake / 1000.0 if layout == "scaled" else brake
    return (
        timeout_ms <= _LONGEST_MS
        and math.isfinite(amperes)
        and (amperes == 0.0 or _SMALLEST_A <= amperes <= _LARGEST_A)
    )
