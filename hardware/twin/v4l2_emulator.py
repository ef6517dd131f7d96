"""Video devices that answer the kernel's requests byte by byte, and misbehave as real ones do.

Everything here is packed and unpacked by offset, from what a C compiler says about ``linux/videodev2.h`` on 64-bit machines: it
shares no structure with the driver that it tests. Sizes are rounded and formats replaced without an error, values clamped, frames
dropped when no buffer is queued, and an unplugged device answers ENODEV; all of it as ``uvcvideo`` does.
"""

from __future__ import annotations

import ctypes
import errno
import os
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_QUERYCAP, _ENUM_FMT, _G_FMT, _S_FMT = 0x80685600, 0xC0405602, 0xC0D05604, 0xC0D05605
_REQBUFS, _QUERYBUF, _QBUF, _DQBUF = 0xC0145608, 0xC0585609, 0xC058560F, 0xC0585611
_STREAMON, _STREAMOFF, _G_PARM, _S_PARM = 0x40045612, 0x40045613, 0xC0CC5615, 0xC0CC5616
_G_CTRL, _S_CTRL, _QUERYCTRL = 0xC008561B, 0xC008561C, 0xC0445624
_ENUM_SIZES, _ENUM_INTERVALS, _UVC_QUERY = 0xC02C564A, 0xC034564B, 0xC0107521
_CAPTURE_AND_STREAMING, _METADATA, _HAS_DEVICE_CAPS = 0x04200001, 0x04A00000, 0x80000000
_PAGE = 4096
_BYTES_PER_PIXEL = {"YUYV": 2.0, "UYVY": 2.0, "YVYU": 2.0, "GREY": 1.0, "NV12": 1.0, "RGB3": 3.0, "BGR3": 3.0}
AUTO_EXPOSURE, EXPOSURE, EXPOSURE_PRIORITY = 0x009A0901, 0x009A0902, 0x009A0903
AUTO_WHITE_BALANCE, WHITE_BALANCE, GAIN, BRIGHTNESS = 0x0098090C, 0x0098091A, 0x00980913, 0x00980900
# The value of the first must be the third, or the second cannot be set.
_GUARDS = {EXPOSURE: (AUTO_EXPOSURE, 1), WHITE_BALANCE: (AUTO_WHITE_BALANCE, 0)}


@dataclass
class ControlState:
    """One control of a device.

    Attributes:
        minimum: Smallest value.
        maximum: Greatest value.
        step: Values are rounded down to a multiple of it.
        value: Present value.
        stuck: Accepts values and keeps its own.
    """

    minimum: int
    maximum: int
    step: int
    value: int
    stuck: bool = False


def webcam_controls() -> dict[int, ControlState]:
    """Controls of a usual USB webcam, with its automatics on."""
    return {
        AUTO_EXPOSURE: ControlState(0, 3, 1, 3),
        EXPOSURE: ControlState(3, 2047, 1, 250),
        EXPOSURE_PRIORITY: ControlState(0, 1, 1, 1),
        AUTO_WHITE_BALANCE: ControlState(0, 1, 1, 1),
        WHITE_BALANCE: ControlState(2000, 6500, 10, 4000),
        GAIN: ControlState(0, 255, 1, 64),
        BRIGHTNESS: ControlState(0, 255, 1, 128),
    }


@dataclass
class _Buffer:
    memory: bytearray
    used: int = 0
    flags: int = 0
    stamp_ns: int = 0
    sequence: int = 0


@dataclass
class VideoDevice:
    """One device of the emulator; frames come when `expose` is called.

    Attributes:
        formats: Sizes by pixel format.
        rates: Frames per second that it can do.
        controls: Its controls by number.
        metadata_only: It is the second device of a webcam, which delivers no pictures.
        padding_bytes: Unused bytes at the end of every row.
        stamp_flags: Clock and event of its stamps, as in ``v4l2_buffer.flags``.
        after_start: What it does to itself when the stream starts.
        extension: Answers requests to the extension units of a UVC device: unit, selector, query, data.
        card: Its name.
    """

    formats: dict[str, list[tuple[int, int]]] = field(default_factory=lambda: {"YUYV": [(640, 480), (320, 240)]})
    rates: tuple[float, ...] = (30.0, 15.0)
    controls: dict[int, ControlState] = field(default_factory=webcam_controls)
    metadata_only: bool = False
    padding_bytes: int = 0
    stamp_flags: int = 0x12000  # monotonic, start of exposure
    after_start: Callable[[VideoDevice], None] | None = None
    extension: Callable[[int, int, int, bytearray], None] | None = None
    card: str = "Emulated Camera"

    def __post_init__(self) -> None:
        self.condition = threading.Condition()
        self.there = True
        self.owner: int | None = None
        self.pixel_format = next(iter(self.formats))
        self.width, self.height = self.formats[self.pixel_format][0]
        self.rate = self.rates[0]
        self.reset()

    def reset(self) -> None:
        """Forget buffers and stream, as after the last user has left."""
        self.streaming = False
        self.sequence = 0
        self.buffers: list[_Buffer] = []
        self.queued: deque[int] = deque()
        self.done: deque[int] = deque()

    @property
    def row_bytes(self) -> int:
        """Bytes from one row to the next; 0 for compressed formats."""
        per_pixel = _BYTES_PER_PIXEL.get(self.pixel_format)
        return 0 if per_pixel is None else int(self.width * per_pixel) + self.padding_bytes

    @property
    def picture_bytes(self) -> int:
        """Size of a picture's buffer."""
        rows = self.height * 3 // 2 if self.pixel_format == "NV12" else self.height
        return rows * self.row_bytes or self.width * self.height * 2

    def expose(self, data: bytes, stamp_ns: int | None = None, damaged: bool = False) -> None:
        """One frame; lost, with its number, if no buffer is queued."""
        with self.condition:
            if not (self.there and self.streaming):
                return
            sequence, self.sequence = self.sequence, self.sequence + 1
            if not self.queued:
                return
            index = self.queued.popleft()
            buffer = self.buffers[index]
            buffer.memory[: len(data)] = data
            buffer.used, buffer.sequence = len(data), sequence
            buffer.stamp_ns = time.monotonic_ns() if stamp_ns is None else stamp_ns
            buffer.flags = self.stamp_flags | (0x40 if damaged else 0)
            self.done.append(index)
            self.condition.notify_all()

    def unplug(self) -> None:
        """Pull the cable."""
        with self.condition:
            self.there = False
            self.reset()
            self.condition.notify_all()

    def plug(self) -> None:
        """Put the cable back; the device has forgotten its settings."""
        with self.condition:
            self.reset()
            self.owner = None
            self.there = True


class VideoPortEmulator:
    """System calls on emulated devices; see `hardware.cameras.v4l2_port.VideoPort`.

    Args:
        devices: Devices by path.
    """

    def __init__(self, devices: dict[str, VideoDevice]) -> None:
        self.devices = devices
        self.calls: list[int] = []
        self._open: dict[int, VideoDevice] = {}
        self._next_fd = 1000

    def open(self, path: Path) -> int:
        """Open a device that is plugged in."""
        device = self.devices.get(str(path))
        if device is None or not device.there:
            raise _error(errno.ENOENT)
        self._next_fd += 1
        self._open[self._next_fd] = device
        return self._next_fd

    def ioctl(self, fd: int, request: int, argument: Any) -> None:
        """Answer one request in the bytes of its argument."""
        device = self._open.get(fd)
        if device is None:
            raise _error(errno.EBADF)
        self.calls.append(request)
        with device.condition:
            if not device.there:
                raise _error(errno.ENODEV)
            answer = _ANSWERS.get(request)
            if answer is None:
                raise _error(errno.ENOTTY)
            answer(device, fd, memoryview(argument).cast("B"))

    def map(self, fd: int, length: int, offset: int) -> Any:
        """Map a buffer."""
        device = self._open[fd]
        index = offset // _PAGE
        if offset % _PAGE or index >= len(device.buffers) or length != len(device.buffers[index].memory):
            raise _error(errno.EINVAL)
        return _mapping(device.buffers[index].memory)

    def wait(self, fd: int, timeout_s: float) -> bool:
        """Wait until a buffer is filled."""
        device = self._open[fd]
        with device.condition:
            device.condition.wait_for(lambda: device.done or not device.there, timeout_s)
            if not device.there or not device.streaming:
                raise _error(errno.ENODEV)
            return bool(device.done)

    def close(self, fd: int) -> None:
        """Close a device."""
        device = self._open.pop(fd)
        with device.condition:
            if device.owner == fd:
                device.owner = None
                device.reset()

    def names(self) -> list[str]:
        """Devices that are plugged in."""
        return sorted(path for path, device in self.devices.items() if device.there)

    @property
    def open_files(self) -> int:
        """How many descriptors are open."""
        return len(self._open)


def _mapping(memory: bytearray) -> Any:
    """Array over a device's memory, with the ``close`` that a mapping has."""
    kind = type("Mapping", (ctypes.c_uint8 * len(memory),), {"close": lambda self: None})
    return kind.from_buffer(memory)  # type: ignore[attr-defined]


def _error(number: int) -> OSError:
    return OSError(number, os.strerror(number))


def _fourcc(name: str) -> bytes:
    return name.encode().ljust(4)


def _text(view: memoryview, offset: int, text: str) -> None:
    view[offset : offset + len(text)] = text.encode()


def _querycap(device: VideoDevice, fd: int, view: memoryview) -> None:
    _text(view, 0, "uvcvideo")
    _text(view, 16, device.card)
    _text(view, 48, "usb-0000:00:14.0-1")
    caps = _METADATA if device.metadata_only else _CAPTURE_AND_STREAMING
    # The first number is about the whole device, the second about this node.
    struct.pack_into("<II", view, 84, _CAPTURE_AND_STREAMING | _METADATA | _HAS_DEVICE_CAPS, caps)


def _enum_format(device: VideoDevice, fd: int, view: memoryview) -> None:
    view[44:48] = _fourcc(_pick(device.formats, struct.unpack_from("<I", view, 0)[0]))


def _enum_sizes(device: VideoDevice, fd: int, view: memoryview) -> None:
    index, name = struct.unpack_from("<I4s", view, 0)
    struct.pack_into("<III", view, 8, 1, *_pick(device.formats.get(name.decode(), []), index))


def _enum_intervals(device: VideoDevice, fd: int, view: memoryview) -> None:
    rate = _pick(device.rates, struct.unpack_from("<I", view, 0)[0])
    struct.pack_into("<III", view, 16, 1, 1000, round(rate * 1000))


def _pick(values: Iterable[Any], index: int) -> Any:
    values = list(values)
    if index >= len(values):
        raise _error(errno.EINVAL)
    return values[index]


def _get_format(device: VideoDevice, fd: int, view: memoryview) -> None:
    struct.pack_into(
        "<II4sIIII", view, 8, device.width, device.height, _fourcc(device.pixel_format), 1, device.row_bytes,
        device.picture_bytes, 8,
    )  # fmt: skip


def _set_format(device: VideoDevice, fd: int, view: memoryview) -> None:
    if device.buffers:
        raise _error(errno.EBUSY)
    width, height, name = struct.unpack_from("<II4s", view, 8)
    device.pixel_format = name.decode() if name.decode() in device.formats else next(iter(device.formats))
    sizes = device.formats[device.pixel_format]
    device.width, device.height = min(sizes, key=lambda size: abs(size[0] - width) + abs(size[1] - height))
    _get_format(device, fd, view)


def _get_rate(device: VideoDevice, fd: int, view: memoryview) -> None:
    struct.pack_into("<IIII", view, 4, 0x1000, 0, 1000, round(device.rate * 1000))


def _set_rate(device: VideoDevice, fd: int, view: memoryview) -> None:
    if device.streaming:
        raise _error(errno.EBUSY)
    numerator, denominator = struct.unpack_from("<II", view, 12)
    device.rate = min(device.rates, key=lambda rate: abs(rate - denominator / max(numerator, 1)))
    _get_rate(device, fd, view)


def _request_buffers(device: VideoDevice, fd: int, view: memoryview) -> None:
    count, kind, memory = struct.unpack_from("<III", view, 0)
    if (kind, memory) != (1, 1):
        raise _error(errno.EINVAL)
    if device.streaming or device.owner not in (None, fd):
        raise _error(errno.EBUSY)
    size = -(-device.picture_bytes // _PAGE) * _PAGE
    device.buffers = [_Buffer(bytearray(size)) for _ in range(min(count, 32))]
    device.queued.clear()
    device.done.clear()
    device.owner = fd if count else None
    struct.pack_into("<I", view, 0, len(device.buffers))


def _index(device: VideoDevice, view: memoryview) -> int:
    index, kind = struct.unpack_from("<II", view, 0)
    memory = struct.unpack_from("<I", view, 60)[0]
    if index >= len(device.buffers) or (kind, memory) != (1, 1):
        raise _error(errno.EINVAL)
    return int(index)


def _query_buffer(device: VideoDevice, fd: int, view: memoryview) -> None:
    index = _index(device, view)
    struct.pack_into("<I", view, 64, index * _PAGE)
    struct.pack_into("<I", view, 72, len(device.buffers[index].memory))


def _queue(device: VideoDevice, fd: int, view: memoryview) -> None:
    index = _index(device, view)
    if index in device.queued or index in device.done:
        raise _error(errno.EINVAL)
    device.queued.append(index)


def _dequeue(device: VideoDevice, fd: int, view: memoryview) -> None:
    if not device.streaming:
        raise _error(errno.EINVAL)
    if not device.done:
        raise _error(errno.EAGAIN)
    index = device.done.popleft()
    buffer = device.buffers[index]
    struct.pack_into("<IIIII", view, 0, index, 1, buffer.used, buffer.flags, 1)
    struct.pack_into("<qq", view, 24, buffer.stamp_ns // 10**9, buffer.stamp_ns % 10**9 // 1000)
    struct.pack_into("<II", view, 56, buffer.sequence, 1)
    struct.pack_into("<I", view, 72, len(buffer.memory))


def _stream_on(device: VideoDevice, fd: int, view: memoryview) -> None:
    if not device.buffers or device.owner != fd:
        raise _error(errno.EINVAL)
    device.streaming, device.sequence = True, 0
    if device.after_start:
        device.after_start(device)


def _stream_off(device: VideoDevice, fd: int, view: memoryview) -> None:
    if device.owner not in (None, fd):
        raise _error(errno.EBUSY)
    device.streaming = False
    device.queued.clear()
    device.done.clear()


def _control(device: VideoDevice, view: memoryview) -> tuple[int, ControlState]:
    number = struct.unpack_from("<I", view, 0)[0]
    if number not in device.controls:
        raise _error(errno.EINVAL)
    return number, device.controls[number]


def _query_control(device: VideoDevice, fd: int, view: memoryview) -> None:
    _, control = _control(device, view)
    struct.pack_into("<iiiiI", view, 40, control.minimum, control.maximum, control.step, control.value, 0)


def _get_control(device: VideoDevice, fd: int, view: memoryview) -> None:
    struct.pack_into("<i", view, 4, _control(device, view)[1].value)


def _set_control(device: VideoDevice, fd: int, view: memoryview) -> None:
    number, control = _control(device, view)
    guard = _GUARDS.get(number)
    if guard and guard[0] in device.controls and device.controls[guard[0]].value != guard[1]:
        raise _error(errno.EACCES)
    value = min(max(struct.unpack_from("<i", view, 4)[0], control.minimum), control.maximum)
    if not control.stuck:
        control.value = control.minimum + (value - control.minimum) // control.step * control.step


def _extension(device: VideoDevice, fd: int, view: memoryview) -> None:
    if device.extension is None:
        raise _error(errno.ENOENT)
    unit, selector, query, size, address = struct.unpack_from("<BBBxHxxQ", view, 0)
    data = bytearray(ctypes.string_at(address, size))
    device.extension(unit, selector, query, data)
    ctypes.memmove(address, bytes(data), size)


_ANSWERS: dict[int, Callable[[VideoDevice, int, memoryview], None]] = {
    _QUERYCAP: _querycap, _ENUM_FMT: _enum_format, _G_FMT: _get_format, _S_FMT: _set_format, _REQBUFS: _request_buffers,
    _QUERYBUF: _query_buffer, _QBUF: _queue, _DQBUF: _dequeue, _STREAMON: _stream_on, _STREAMOFF: _stream_off,
    _G_PARM: _get_rate, _S_PARM: _set_rate, _G_CTRL: _get_control, _S_CTRL: _set_control, _QUERYCTRL: _query_control,
    _ENUM_SIZES: _enum_sizes, _ENUM_INTERVALS: _enum_intervals, _UVC_QUERY: _extension,
}  # fmt: skip
