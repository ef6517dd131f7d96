"""The VESC motor controller on its serial port: speed and steering in, bytes out, telemetry back.

One thread, no heartbeat: the controller's own time-out must see it when this process stops deciding, so nothing here sends
anything by itself. The servo has no acknowledgement and no watchdog; every drive command therefore sends the servo first, then
the rpm.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from types import TracebackType

import serial

from hardware.errors import DeviceBusy, DeviceNotFound, LinkLost, LinkTimeout, ProtocolError
from hardware.limits import DriveLimiter, DriveLimits, VehicleGains
from hardware.vesc_codec import Command, CommandId, FrameDecoder, decode_command, encode_command
from hardware.vesc_replies import FirmwareVersion, Values, decode_firmware_version, decode_values

# Below this the car counts as standing; the firmware's slowest closed-loop speed is 900 (about 0.2 m/s).
STANDSTILL_ERPM = 100.0


@dataclass(frozen=True)
class Sent:
    """What really went down the wire, after limits and the rounding of the protocol.

    Attributes:
        speed_mps: Speed that the sent rpm means [m/s]; 0 when braking or coasting.
        steering_rad: Front wheel angle that the sent servo value means [rad]; the last one when no servo was sent.
        erpm: Electrical rpm sent; 0 when braking or coasting.
        servo: Servo value sent, or the last one sent.
        brake_current_a: Brake current sent [A]; None if this was no brake command.
        write_mono_ns: Monotonic time just after the bytes were handed to the kernel [ns].
        write_real_ns: The same instant in real time [ns].
    """

    speed_mps: float
    steering_rad: float
    erpm: float
    servo: float
    brake_current_a: float | None
    write_mono_ns: int
    write_real_ns: int

    @property
    def braking(self) -> bool:
        """Whether this was a brake command."""
        return self.brake_current_a is not None


class Vesc:
    """Driver of one VESC. Use it as a context manager: leaving the block brakes the car, then lets the motor go.

    Args:
        port: Serial device, e.g. ``/dev/vesc``, or the pty of the twin.
        gains: The car's measured gains.
        limits: What may be sent.
        stop_brake_current_a: Brake current for commands that are not finite, and on leaving the context [A].
        write_timeout_s: How long the kernel may refuse bytes before the link counts as hung [s].
    """

    def __init__(
        self,
        port: str,
        gains: VehicleGains,
        limits: DriveLimits,
        stop_brake_current_a: float = 20.0,
        write_timeout_s: float = 0.05,
    ) -> None:
        self.port = port
        self.gains = gains
        self.limiter = DriveLimiter(limits)
        self.firmware: FirmwareVersion | None = None
        self.last_reply_mono_ns = 0
        self._stop_brake_current_a = stop_brake_current_a
        self._write_timeout_s = write_timeout_s
        self._serial: serial.Serial | None = None
        self._decoder = FrameDecoder()
        self._servo = _as_sent(CommandId.SET_SERVO_POS, gains.servo(0.0))

    def open(self) -> None:
        """Open the port for this process alone."""
        try:
            self._serial = serial.Serial(
                self.port, baudrate=115200, timeout=0, write_timeout=self._write_timeout_s, exclusive=True
            )
        except (serial.SerialException, OSError, ValueError) as error:
            if "exclusively lock" in str(error) or "Resource temporarily unavailable" in str(error):
                raise DeviceBusy(
                    f"expected {self.port} to be free, but another process holds it: stop that first"
                ) from error
            raise DeviceNotFound(
                f"expected a VESC at {self.port}, cannot open it ({error}): is it plugged in and its udev rule installed?"
            ) from error
        self._decoder = FrameDecoder()

    def close(self, brake_s: float = 1.0) -> None:
        """Brake until the car stands (at most ``brake_s``), let the motor go, close the port. Never raises on a dead link."""
        if self._serial is None:
            return
        try:
            self._brake_to_standstill(brake_s)
            self.release()
        except (LinkLost, LinkTimeout):
            pass  # the controller's own time-out is all that is left
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the port without a word, after the link broke."""
        if self._serial is not None:
            self._serial.close()
            self._serial = None

    def __enter__(self) -> Vesc:
        if self._serial is None:
            self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._serial is not None

    def identify(self, timeout_s: float = 0.5) -> FirmwareVersion:
        """Ask for the firmware version and wait for the answer."""
        self._write(encode_command(CommandId.FW_VERSION))
        self._wait_for(FirmwareVersion, timeout_s)
        assert self.firmware is not None
        return self.firmware

    def drive(self, speed_mps: float, steering_rad: float) -> Sent:
        """Send steering and speed, limited; a command that is not finite brakes instead."""
        setpoint = self.limiter.apply(speed_mps, steering_rad, time.monotonic())
        if setpoint is None:
            return self.brake(self._stop_brake_current_a)
        servo = self.gains.servo(setpoint.steering_rad)
        erpm = self.gains.erpm(setpoint.speed_mps)
        self._write(encode_command(CommandId.SET_SERVO_POS, servo) + encode_command(CommandId.SET_RPM, erpm))
        self._servo = _as_sent(CommandId.SET_SERVO_POS, servo)
        return self._sent(erpm=_as_sent(CommandId.SET_RPM, erpm))

    def brake(self, current_a: float) -> Sent:
        """Brake with a motor current [A]; steering stays where it is."""
        current_a = abs(current_a) if math.isfinite(current_a) else self._stop_brake_current_a
        self.limiter.stop()
        self._write(encode_command(CommandId.SET_CURRENT_BRAKE, current_a))
        return self._sent(brake_current_a=_as_sent(CommandId.SET_CURRENT_BRAKE, current_a))

    def release(self) -> Sent:
        """Zero current: the motor turns freely."""
        self.limiter.stop()
        self._write(encode_command(CommandId.SET_CURRENT, 0.0))
        return self._sent()

    def request_values(self) -> None:
        """Ask for telemetry; the answer comes with a later `receive`."""
        self._write(encode_command(CommandId.GET_VALUES))

    def receive(self) -> list[Values | FirmwareVersion]:
        """Replies that have arrived, without waiting."""
        if self._serial is None:
            raise LinkLost(f"expected an open port, {self.port} is closed")
        try:
            data = self._serial.read(self._serial.in_waiting)
        except OSError as error:  # pyserial's errors are OSErrors; a hang-up also raises the bare one
            raise LinkLost(f"lost the VESC at {self.port} ({error}): check the USB cable") from error
        replies = [reply for payload in self._decoder.feed(data) if (reply := self._decode(payload)) is not None]
        if replies:
            self.last_reply_mono_ns = time.monotonic_ns()
        return replies

    def read_values(self, timeout_s: float = 0.1) -> Values:
        """Ask for telemetry and wait for it."""
        self.request_values()
        reply = self._wait_for(Values, timeout_s)
        assert isinstance(reply, Values)
        return reply

    def _decode(self, payload: bytes) -> Values | FirmwareVersion | None:
        if payload[0] == CommandId.GET_VALUES:
            return decode_values(payload)
        if payload[0] == CommandId.FW_VERSION:
            self.firmware = decode_firmware_version(payload)
            return self.firmware
        return None  # some other program's question, or a message of the controller's script

    def _wait_for(self, kind: type[Values] | type[FirmwareVersion], timeout_s: float) -> Values | FirmwareVersion:
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            for reply in self.receive():
                if isinstance(reply, kind):
                    return reply
            time.sleep(0.001)
        raise LinkTimeout(
            f"expected {kind.__name__} from {self.port} within {timeout_s} s, got nothing: is this a VESC, and is it powered?"
        )

    def _brake_to_standstill(self, brake_s: float) -> None:
        deadline = time.monotonic() + brake_s
        self.brake(self._stop_brake_current_a)
        while time.monotonic() < deadline:
            try:
                if abs(self.read_values(timeout_s=0.1).erpm) < STANDSTILL_ERPM:
                    return
            except (LinkTimeout, ProtocolError):
                pass  # a silent controller still gets its brake command, until the deadline
            self.brake(self._stop_brake_current_a)
            time.sleep(0.02)

    def _write(self, data: bytes) -> None:
        if self._serial is None:
            raise LinkLost(f"expected an open port, {self.port} is closed")
        try:
            self._serial.write(data)
        except serial.SerialTimeoutException as error:
            raise LinkTimeout(
                f"expected {self.port} to take {len(data)} bytes, it is blocked: the VESC hangs"
            ) from error
        except OSError as error:
            raise LinkLost(f"lost the VESC at {self.port} ({error}): check the USB cable") from error

    def _sent(self, erpm: float | None = None, brake_current_a: float | None = None) -> Sent:
        return Sent(
            speed_mps=0.0 if erpm is None else self.gains.speed_mps(erpm),
            steering_rad=self.gains.steering_rad(self._servo),
            erpm=0.0 if erpm is None else erpm,
            servo=self._servo,
            brake_current_a=brake_current_a,
            write_mono_ns=time.monotonic_ns(),
            write_real_ns=time.time_ns(),
        )


def _as_sent(command: CommandId, value: float) -> float:
    """The value that the other end reads after the protocol's truncation."""
    decoded = decode_command(encode_command(command, value)[2:-3])
    assert isinstance(decoded, Command)
    return 0.0 if decoded.value is None else decoded.value
