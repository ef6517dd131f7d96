"""Firmware of the twin's motor controller: how a VESC reacts to received bytes, without I/O and without a clock.

It reproduces the behaviour of the stock firmware that matters for safety: the command time-out (checked every 10 ms, not reset by telemetry
requests, braking with a configured current that is 0 A as delivered), the servo without any time-out, the servo output that
is off in stock builds, and speed commands below the slowest closed-loop speed that short the motor instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from pydantic import Field

from advnerf_core.strict import StrictModel
from hardware.motor.vesc_codec import Command, CommandId, FrameDecoder, decode_command, encode_frame
from hardware.motor.vesc_replies import FirmwareVersion, Values, encode_firmware_version, encode_values
from hardware.motor.vesc_settings import AppConfiguration, TimeoutSettings, decode_app_configuration
from hardware.worlds.lab.vehicle import TwinVehicle

TWIN_HARDWARE_NAME = "TWIN"
_TIMEOUT_CHECK_NS = 10_000_000
# Heads of the application configuration by firmware, an arbitrary signature, and the settings behind the head.
_SIGNATURE, _TAIL = b"\x54\x57\x49\x4e", bytes(range(256)) + bytes(100)
_RESETS_TIMEOUT = {
    CommandId.SET_DUTY, CommandId.SET_CURRENT, CommandId.SET_CURRENT_BRAKE, CommandId.SET_RPM, CommandId.ALIVE,
}  # fmt: skip


class VescEmulatorConfig(StrictModel):
    """Settings that a real VESC keeps in its application and motor configuration.

    Attributes:
        timeout_ms: Time without a motor command after which the firmware takes over [ms]; 0 never. As delivered: 1000 ms.
        timeout_brake_current_a: Brake current on time-out [A]. As delivered: 0 A, the car coasts.
        servo_output: Whether SET_SERVO_POS moves the servo; stock builds silently ignore it.
        min_erpm: Speed commands below this short the motor.
        max_erpm: Speed commands are clamped to plus and minus this.
        max_current_a: Currents are clamped to plus and minus this [A].
        firmware: Reported version.
        hardware_name: Reported name; ``TWIN`` tells the motor node that no real car can move.
        generation: Layout of the telemetry, ``A`` to ``G``.
        supply_v: Reported battery voltage [V].
        readable_settings: Whether it answers GET_APPCONF.
    """

    timeout_ms: float = Field(default=1000.0, ge=0.0)
    timeout_brake_current_a: float = Field(default=0.0, ge=0.0)
    servo_output: bool = True
    min_erpm: float = Field(default=900.0, ge=0.0)
    max_erpm: float = Field(default=30000.0, gt=0.0)
    max_current_a: float = Field(default=60.0, gt=0.0)
    firmware: tuple[int, int] = (5, 2)
    hardware_name: str = TWIN_HARDWARE_NAME
    generation: str = Field(default="F", pattern="^[A-G]$")
    supply_v: float = 15.2
    readable_settings: bool = True


@dataclass(frozen=True)
class WireEvent:
    """An event at the controller.

    Attributes:
        mono_ns: Monotonic time [ns].
        name: Command name, or TIMEOUT, STANDSTILL, MOVING, RESET.
        value: Argument of the command, if any.
    """

    mono_ns: int
    name: str
    value: float | None = None


class VescFirmware:
    """Decodes commands, drives the plant, answers, and brakes after its time-out when commands stop.

    Args:
        erpm_per_mps: Electrical rpm per speed of the plant, for the tachometer [1/(m/s)].

    Attributes:
        fault: Reported fault code; while it is not 0, every command to move releases the motor.
        timed_out: Whether the firmware's time-out is active.
        commanded: Whether the last motor command makes the car move.
    """

    def __init__(self, config: VescEmulatorConfig, plant: TwinVehicle, erpm_per_mps: float = 4614.0) -> None:
        self.config = config
        self._plant = plant
        # Six counts per electrical revolution.
        self._counts_per_m = 6.0 * erpm_per_mps / 60.0
        self._decoder = FrameDecoder()
        self._fed_ns: int | None = None
        self._checked_ns = 0
        self._version = FirmwareVersion(*config.firmware, config.hardware_name, b"advnerf-twin")
        self._settings = _app_configuration(config)
        self.fault = 0
        self.timed_out = False
        self.commanded = False

    @property
    def timeout(self) -> TimeoutSettings:
        """Current time-out and brake current."""
        return self._settings.timeout

    def receive(self, data: bytes, mono_ns: int) -> tuple[bytes, list[WireEvent]]:
        """Process received bytes; returns the reply bytes and the decoded commands."""
        replies, events = b"", []
        for payload in self._decoder.feed(data):
            command = decode_command(payload)
            if command is None:
                continue
            if command.id == CommandId.SET_APPCONF:
                replies += self._store(payload)
            replies += self._obey(command, mono_ns)
            events.append(WireEvent(mono_ns, command.name, command.value))
        return replies, events

    def check_timeout(self, mono_ns: int) -> list[WireEvent]:
        """Call often: the firmware's watchdog, which checks every 10 ms."""
        if mono_ns - self._checked_ns < _TIMEOUT_CHECK_NS:
            return []
        self._checked_ns = mono_ns
        limit_ns = self.timeout.timeout_ms * 1e6
        if self._fed_ns is None or limit_ns == 0.0 or self.timed_out or mono_ns - self._fed_ns <= limit_ns:
            return []
        self.timed_out = True
        self.commanded = False
        self._plant.command(brake_current_a=self.timeout.brake_current_a)
        return [WireEvent(mono_ns, "TIMEOUT", self.timeout.brake_current_a)]

    def _obey(self, command: Command, mono_ns: int) -> bytes:
        if command.id in _RESETS_TIMEOUT:
            self._fed_ns, self.timed_out = mono_ns, False
        if command.id == CommandId.FW_VERSION:
            return encode_frame(encode_firmware_version(self._version))
        if command.id == CommandId.GET_APPCONF and self.config.readable_settings:
            return encode_frame(bytes([CommandId.GET_APPCONF]) + self._settings.data)
        if command.id == CommandId.GET_VALUES:
            return encode_frame(encode_values(self._values()))
        if command.value is not None and math.isfinite(command.value):
            self._actuate(CommandId(command.id), command.value)
        return b""

    def _store(self, payload: bytes) -> bytes:
        data = payload[1:]
        same_kind = len(data) == len(self._settings.data) and (
            self._settings.layout != "signed" or data.startswith(_SIGNATURE)
        )
        if not same_kind:
            return b""  # the firmware silently rejects a wrong signature
        self._settings = decode_app_configuration(bytes([CommandId.GET_APPCONF]) + data, self._version)
        return encode_frame(bytes([CommandId.SET_APPCONF]))

    def _actuate(self, command: CommandId, value: float) -> None:
        amperes = min(max(value, -self.config.max_current_a), self.config.max_current_a)
        if command == CommandId.SET_SERVO_POS:
            if self.config.servo_output:
                self._plant.command(servo=min(max(value, 0.0), 1.0))
            return
        # Whether a command makes the car move. It must not be lifted meanwhile.
        self.commanded = False
        if self.fault:
            self._plant.command(current_a=0.0)
            return
        if command == CommandId.SET_RPM and abs(value) >= self.config.min_erpm:
            self._plant.command(erpm=min(max(value, -self.config.max_erpm), self.config.max_erpm))
            self.commanded = True
        elif command == CommandId.SET_CURRENT:
            self._plant.command(current_a=amperes)
            self.commanded = amperes != 0.0
        elif command == CommandId.SET_CURRENT_BRAKE:
            self._plant.command(brake_current_a=abs(amperes))
        else:
            # Slow speed commands short the motor. So does every duty cycle here: the twin's motor has no open-loop voltage model.
            self._plant.command(duty=0.0)

    def _values(self) -> Values:
        counts = int(self._plant.odometer_m * self._counts_per_m)
        return Values(
            self.config.generation,
            erpm=self._plant.erpm,
            duty=0.0,
            v_in=self.config.supply_v,
            motor_current_a=0.0,
            input_current_a=0.0,
            tachometer=counts,
            tachometer_abs=abs(counts),
            fault=self.fault,
            used_ah=0.0,
            charged_ah=0.0,
            used_wh=0.0,
            charged_wh=0.0,
            temp_fet_c=25.0,
            temp_motor_c=25.0,
            status=int(self.timed_out),
        )


def _app_configuration(config: VescEmulatorConfig) -> AppConfiguration:
    """Application configuration in the form of this firmware version: the head, then unused bytes."""
    if config.firmware < (3, 7):
        empty = AppConfiguration(bytes(9) + _TAIL, "scaled")
    elif config.firmware < (5, 0):
        empty = AppConfiguration(bytes(9) + _TAIL, "plain")
    else:
        empty = AppConfiguration(_SIGNATURE + bytes(9) + _TAIL, "signed")
    return empty.with_timeout(TimeoutSettings(round(config.timeout_ms), config.timeout_brake_current_a))
