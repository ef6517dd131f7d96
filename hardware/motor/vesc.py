"""Driver of the VESC motor controller on a serial port: sends speed and steering, and receives telemetry.

One thread, no heartbeat: the controller's own time-out must act when this process stops deciding, so nothing here sends
by itself. The servo has no acknowledgement and no watchdog; every drive command therefore sends the servo first, then
the rpm.
"""

from __future__ import annotations

import math
import os
import select
import time
from types import TracebackType
from typing import TypeVar

import serial

from hardware.errors import DeviceBusy, DeviceNotFound, LinkLost, LinkTimeout, ProtocolError
from hardware.motor.limits import DriveLimiter, DriveLimits, Sent, VehicleGains
from hardware.motor.vesc_codec import CommandId, FrameDecoder, as_sent, encode_command
from hardware.motor.vesc_replies import FirmwareVersion, Values, decode_firmware_version, decode_values
from hardware.motor.vesc_settings import AppConfiguration, Stored, TimeoutSettings, decode_app_configuration

# Below this the car counts as standing; the firmware's slowest closed-loop speed is 900 (about 0.2 m/s).
STANDSTILL_ERPM = 100.0
# Storing a configuration takes the firmware 0.2 s of deliberate waiting, and the flash memory some more.
_STORE_S = 2.0
# The bytes of one frame are contiguous; after a pause of this length within it the rest will not come [ns].
_SILENCE_NS = 20_000_000


Reply = Values | FirmwareVersion | AppConfiguration | Stored
R = TypeVar("R", Values, FirmwareVersion, AppConfiguration, Stored)


class Vesc:
    """Driver of one VESC. Use it as a context manager: leaving the block brakes the car, then releases the motor.

    Args:
        port: Serial device, e.g. ``/dev/vesc``, or the pty of the twin.
        gains: The car's measured gains.
        limits: Limits of the sent commands.
        stop_brake_current_a: Brake current for commands that are not finite, and on leaving the context [A].
        write_timeout_s: After this time without accepted bytes the link counts as hung [s].
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
        self._heard_ns = 0
        self._servo = as_sent(CommandId.SET_SERVO_POS, gains.servo(0.0))

    def open(self) -> None:
        """Open the port for this process alone."""
        try:
            self._serial = serial.Serial(self.port, baudrate=115200, timeout=0, exclusive=True)
        except (serial.SerialException, OSError, ValueError) as error:
            if "exclusively lock" in str(error) or "Resource temporarily unavailable" in str(error):
                raise DeviceBusy(
                    f"expected {self.port} to be free, but another process holds it; stop that process first"
                ) from error
            raise DeviceNotFound(
                f"expected a VESC at {self.port}, cannot open it ({error}); is it plugged in, and is its udev rule installed?"
            ) from error
        self._decoder = FrameDecoder()

    def close(self, brake_s: float = 1.0) -> None:
        """Brake until the car stands (at most ``brake_s``), release the motor, and close the port. Never raises on a lost link."""
        if self._serial is None:
            return
        try:
            self._brake_to_standstill(brake_s)
            self.release()
        except (LinkLost, LinkTimeout):
            pass  # only the controller's own time-out remains
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the port without sending a command, after the link was lost."""
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
        """Request the firmware version and wait for the answer."""
        self._write(encode_command(CommandId.FW_VERSION))
        return self._wait_for(FirmwareVersion, timeout_s)

    def request_app_configuration(self) -> None:
        """Request the application configuration; a later `receive` returns the answer. Identify the controller first."""
        self._write(encode_command(CommandId.GET_APPCONF))

    def read_timeout(self, timeout_s: float = 0.5) -> TimeoutSettings:
        """The controller's own time-out and its brake current then. Identify the controller first."""
        return self._read_app_configuration(timeout_s).timeout

    def set_timeout(self, settings: TimeoutSettings) -> TimeoutSettings:
        """Store another time-out and brake current in a controller whose motor stands; returns the values read back.

        Raises:
            ProtocolError: The motor turns, or the values read back differ from the sent ones.
            LinkTimeout: The controller does not answer.
        """
        before = self._read_app_configuration(0.5)
        if abs(erpm := self.read_values().erpm) >= STANDSTILL_ERPM:
            raise ProtocolError(
                f"expected a motor at rest before its settings change, got {erpm:.0f} erpm; stop the car"
            )
        wanted = before.with_timeout(settings)
        self._write(wanted.encode_set())
        self._wait_for(Stored, _STORE_S)
        if (after := self._read_app_configuration(0.5)).data != wanted.data:
            raise ProtocolError(
                f"expected the controller to keep a time-out of {settings}, read back {after.timeout}; set it in VESC Tool"
            )
        return after.timeout

    def _read_app_configuration(self, timeout_s: float) -> AppConfiguration:
        self.request_app_configuration()
        return self._wait_for(AppConfiguration, timeout_s)

    def steer(self, steering_rad: float) -> Sent:
        """Send only the steering, for a standing car. The motor command does not change."""
        servo = self.gains.servo(self.limiter.steer(steering_rad))
        self._write(encode_command(CommandId.SET_SERVO_POS, servo))
        self._servo = as_sent(CommandId.SET_SERVO_POS, servo)
        return self._sent()

    def drive(self, speed_mps: float, steering_rad: float) -> Sent:
        """Send steering and speed, limited; a command that is not finite brakes instead."""
        setpoint = self.limiter.apply(speed_mps, steering_rad, time.monotonic())
        if setpoint is None:
            return self.brake(self._stop_brake_current_a)
        servo = self.gains.servo(setpoint.steering_rad)
        erpm = self.gains.erpm(setpoint.speed_mps)
        self._write(encode_command(CommandId.SET_SERVO_POS, servo) + encode_command(CommandId.SET_RPM, erpm))
        self._servo = as_sent(CommandId.SET_SERVO_POS, servo)
        return self._sent(erpm=as_sent(CommandId.SET_RPM, erpm))

    def brake(self, current_a: float) -> Sent:
        """Brake with a motor current [A]; steering does not change."""
        current_a = self.limiter.current(
            abs(current_a) if math.isfinite(current_a) else self._stop_brake_current_a
        )
        self.limiter.stop()
        self._write(encode_command(CommandId.SET_CURRENT_BRAKE, current_a))
        return self._sent(brake_current_a=as_sent(CommandId.SET_CURRENT_BRAKE, current_a))

    def release(self) -> Sent:
        """Zero current: the motor turns freely."""
        self.limiter.stop()
        self._write(encode_command(CommandId.SET_CURRENT, 0.0))
        return self._sent()

    def request_values(self) -> None:
        """Request telemetry; a later `receive` returns the answer."""
        self._write(encode_command(CommandId.GET_VALUES))

    def receive(self) -> list[Reply]:
        """Replies that have arrived, without waiting."""
        if self._serial is None:
            raise LinkLost(f"expected an open port, but {self.port} is closed; call open() first")
        try:
            data = self._serial.read(self._serial.in_waiting)
        except OSError as error:  # pyserial's errors are OSErrors; a hang-up also raises the bare one
            raise LinkLost(f"lost the VESC at {self.port} ({error}); check the USB cable") from error
        frames = self._frames(data)
        try:
            replies = [reply for payload in frames if (reply := self._decode(payload)) is not None]
        except ProtocolError:
            self.last_reply_mono_ns = time.monotonic_ns()  # an answer, though one that is not understood
            raise
        if replies:
            self.last_reply_mono_ns = time.monotonic_ns()
        return replies

    def _frames(self, data: bytes) -> list[bytes]:
        now_ns = time.monotonic_ns()
        if data or not self._decoder.pending:
            self._heard_ns = now_ns
            return self._decoder.feed(data)
        # A false start byte in noise would otherwise hold back the next reply until 500 more bytes have come.
        return self._decoder.give_up() if now_ns - self._heard_ns > _SILENCE_NS else []

    def read_values(self, timeout_s: float = 0.1) -> Values:
        """Request telemetry and wait for it."""
        self.request_values()
        return self._wait_for(Values, timeout_s)

    @property
    def skipped_bytes(self) -> int:
        """Number of received bytes outside of frames since the port was opened."""
        return self._decoder.skipped_bytes

    @property
    def servo(self) -> float:
        """Last servo value sent; before the first one, the value of straight wheels."""
        return self._servo

    def _decode(self, payload: bytes) -> Reply | None:
        if payload[0] == CommandId.GET_VALUES:
            return decode_values(payload)
        if payload[0] == CommandId.FW_VERSION:
            self.firmware = decode_firmware_version(payload)
            return self.firmware
        if payload[0] == CommandId.GET_APPCONF and self.firmware is not None:
            return decode_app_configuration(payload, self.firmware)
        if payload == bytes([CommandId.SET_APPCONF]):
            return Stored()
        return None  # another program's question, or a message of the controller's script

    def _wait_for(self, kind: type[R], timeout_s: float) -> R:
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            for reply in self.receive():
                if isinstance(reply, kind):
                    return reply
            time.sleep(0.001)
        strange = self._decoder.left_over
        got = "nothing; is this a VESC, and is it powered?"
        if strange:
            got = f"{strange} bytes that are no frames of a VESC; is it another device, or at another baud rate?"
        raise LinkTimeout(f"expected {kind.__name__} from {self.port} within {timeout_s} s, got {got}")

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
            raise LinkLost(f"expected an open port, but {self.port} is closed; call open() first")
        try:
            self._put(self._serial.fileno(), data)
        except LinkTimeout:
            raise
        except OSError as error:
            raise LinkLost(f"lost the VESC at {self.port} ({error}); check the USB cable") from error

    def _put(self, fd: int, data: bytes) -> None:
        """Write to the port. pyserial's own write takes a process that was held up for a blocked port, though all bytes were accepted."""
        deadline, left = time.monotonic() + self._write_timeout_s, data
        while left := left[_accepted(fd, left) :]:
            wait_s = deadline - time.monotonic()
            if wait_s <= 0.0 or not select.select([], [fd], [], wait_s)[1]:
                raise LinkTimeout(
                    f"expected {self.port} to take {len(data)} bytes, but it is blocked; the VESC hangs. Restart it"
                )

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


def _accepted(fd: int, data: bytes) -> int:
    """Number of bytes that a port took; 0 of a full one."""
    try:
        return os.write(fd, data)
    except BlockingIOError:
        return 0
