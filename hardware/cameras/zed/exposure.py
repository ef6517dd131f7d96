"""Exposure and gain of a ZED: registers accessed through a UVC extension unit, because the standard controls do not reach them.

Facts (register numbers and the order of bytes) from stereolabs/zed-open-capture, ``videocapture.cpp`` and ``videocapture_def.hpp``:
extension unit 4, selector 2. A message has the task in byte 0 (0x50 write, 0x51 read), the target in byte 1 (0xA2 the image
processor, 0xA3 and 0xA5 the left and right sensor), the width of the address in byte 3, the address in bytes 5 to 8 (most
significant first), counts in bytes 9 to 12, the value to write in byte 16, and the value that was read in byte 17.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hardware.cameras.v4l2 import abi
from hardware.cameras.v4l2.port import VideoPort, request
from hardware.errors import HardwareError, ProtocolError

_UNIT, _SELECTOR = 4, 2
_LENGTHS = (384, 64)  # on USB 3 and USB 2
_WRITE, _READ = 0x50, 0x51
_PROCESSOR, _SENSORS = 0xA2, (0xA3, 0xA5)
_SENSOR_ID, _SENSOR_PAGE = 0x6C, 0x90
_AUTO_REGISTERS = (0x80181033, 0x80181833)  # left, right
_AUTO_BIT = 0x02
_EXPOSURE_REGISTERS = (0x3500, 0x3501, 0x3502)
_GAIN_REGISTERS = (0x3507, 0x3508, 0x3509)
_RAW_MAX = {15: 1550, 30: 1100, 60: 880, 100: 720}
_RAW_MIN = 2
_GAIN_MAX = 0x7FFF
_ANSWER_S = 0.0005  # the device needs 0.3 ms between a request and its answer
EYES = (0, 1)


@dataclass(frozen=True)
class ZedExposure:
    """Exposure and gain to fix on both eyes.

    Attributes:
        exposure_percent: Exposure, in percent of the longest that the frame rate allows; None leaves the automatic on.
        gain_raw: Gain in the sensor's register (0x3507 to 0x3509); None keeps the automatic's last value, which
            differs from start to start.
    """

    exposure_percent: float | None = None
    gain_raw: int | None = None

    def __post_init__(self) -> None:
        if self.exposure_percent is not None and not 0.0 < self.exposure_percent <= 100.0:
            raise ValueError(f"expected an exposure above 0 and up to 100 %, got {self.exposure_percent}")
        if self.gain_raw is not None and not 0 <= self.gain_raw <= _GAIN_MAX:
            raise ValueError(f"expected a gain of 0 to {_GAIN_MAX}, got {self.gain_raw}")
        if self.gain_raw is not None and self.exposure_percent is None:
            raise ValueError(
                "expected exposure_percent with gain_raw, because exposure and gain share one automatic; give both"
            )


def exposure_lines(percent: float, fps: float) -> int:
    """Exposure in the sensor's unit [lines] for a share of the longest at a frame rate."""
    longest = _RAW_MAX.get(round(fps))
    if longest is None:
        raise ValueError(f"expected a rate of {', '.join(map(str, _RAW_MAX))} Hz, got {fps:g}")
    return max(int(longest * percent / 100.0), _RAW_MIN)


class ExtensionUnit:
    """Reads and writes the registers of an open ZED."""

    def __init__(
        self, port: VideoPort, fd: int, path: Path, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._port, self._fd, self._path, self._sleep = port, fd, path, sleep
        self._length = self._read_length()

    def read_processor(self, address: int) -> int:
        """A register of the image processor."""
        return self._read(self._message(_READ, _PROCESSOR, address))

    def write_processor(self, address: int, value: int) -> None:
        """Set a register of the image processor, and read it back."""
        self._send(self._message(_WRITE, _PROCESSOR, address, value))
        self._require(self.read_processor(address), value, address)

    def read_sensor(self, eye: int, address: int) -> int:
        """A register of the sensor of an eye (0 left, 1 right)."""
        return self._read(self._message(_READ, _SENSORS[eye], address))

    def write_sensor(self, eye: int, address: int, value: int) -> None:
        """Set a register of the sensor of an eye, and read it back."""
        self._send(self._message(_WRITE, _SENSORS[eye], address, value))
        self._require(self.read_sensor(eye, address), value, address)

    def _message(self, task: int, target: int, address: int, value: int = 0) -> bytearray:
        message = bytearray(self._length)
        message[0], message[1] = task, target
        message[4], message[10], message[12] = 1, 1, 1
        if target == _PROCESSOR:
            message[3] = 4
        else:
            message[2], message[3], message[9] = _SENSOR_ID, 2, _SENSOR_PAGE
        message[5:9] = address.to_bytes(4, "big")
        message[16] = value
        return message

    def _read(self, message: bytearray) -> int:
        self._send(message)
        answer = bytearray(self._length)
        self._query(abi.UVC_GET_CUR, answer)
        return answer[17]

    def _send(self, message: bytearray) -> None:
        self._query(abi.UVC_SET_CUR, message)
        self._sleep(_ANSWER_S)

    def _read_length(self) -> int:
        data = bytearray(2)
        self._query(abi.UVC_GET_LEN, data)
        length = int.from_bytes(data, "little")
        if length not in _LENGTHS:
            raise ProtocolError(
                f"expected control messages of 64 or 384 bytes from {self._path}, got {length}; is it a ZED?"
            )
        return length

    def _query(self, query: int, data: bytearray) -> None:
        raw = (ctypes.c_uint8 * len(data)).from_buffer(data)
        asked = abi.ExtensionQuery(_UNIT, _SELECTOR, query, len(data), ctypes.addressof(raw))
        try:
            self._port.ioctl(self._fd, abi.UVC_CTRL_QUERY, asked)
        except FileNotFoundError:
            raise HardwareError(
                f"{self._path} has no extension unit {_UNIT}, so it is not a ZED; remove its exposure settings"
            ) from None
        except OSError:
            request(
                self._port, self._fd, self._path, abi.UVC_CTRL_QUERY, asked, "talking to the ZED's registers"
            )

    def _require(self, got: int, wanted: int, address: int) -> None:
        if got != wanted:
            raise ProtocolError(
                f"expected register {address:#x} of {self._path} to hold {wanted:#04x}, got {got:#04x}; unplug the camera and"
                " plug it in again"
            )


def lock_exposure(unit: ExtensionUnit, exposure: ZedExposure, fps: float) -> None:
    """Disable the automatic and set exposure and gain of both eyes. Does nothing without an exposure to fix."""
    if exposure.exposure_percent is None:
        return
    lines = exposure_lines(exposure.exposure_percent, fps)
    # The register counts sixteenths of a line in 20 bits over three bytes.
    sixteenths = (lines << 4).to_bytes(3, "big")
    for eye in EYES:
        automatic = unit.read_processor(_AUTO_REGISTERS[eye])
        unit.write_processor(_AUTO_REGISTERS[eye], automatic & ~_AUTO_BIT & 0xFF)
        for address, value in zip(_EXPOSURE_REGISTERS, sixteenths, strict=True):
            unit.write_sensor(eye, address, value)
        if exposure.gain_raw is not None:
            for address, value in zip(_GAIN_REGISTERS, exposure.gain_raw.to_bytes(3, "big"), strict=True):
                unit.write_sensor(eye, address, value)


def read_gain(unit: ExtensionUnit, eye: int = 0) -> int:
    """Current gain of an eye, in the unit of ``gain_raw``."""
    return int.from_bytes(bytes(unit.read_sensor(eye, address) for address in _GAIN_REGISTERS), "big")


def read_exposure_lines(unit: ExtensionUnit, eye: int = 0) -> int:
    """Current exposure of an eye [lines]."""
    return (
        int.from_bytes(bytes(unit.read_sensor(eye, address) for address in _EXPOSURE_REGISTERS), "big") >> 4
    )


def automatic_is_on(unit: ExtensionUnit, eye: int = 0) -> bool:
    """Whether the device chooses exposure and gain of an eye."""
    return bool(unit.read_processor(_AUTO_REGISTERS[eye]) & _AUTO_BIT)
