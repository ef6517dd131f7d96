"""Answers of an emulated video device to the kernel's requests, packed and unpacked by offset.

The numbers come from a C compiler and ``linux/videodev2.h`` on 64-bit machines; no structure is shared with the tested
driver. Sizes are rounded and formats replaced without an error, values clamped, as in ``uvcvideo``.
"""

from __future__ import annotations

import ctypes
import errno
import os
import struct
from collections.abc import Callable, Iterable
from typing import Any

from tests.support.v4l2_device import (
    AUTO_EXPOSURE,
    AUTO_WHITE_BALANCE,
    EXPOSURE,
    WHITE_BALANCE,
    ControlState,
    FrameBuffer,
    VideoDevice,
)

_QUERYCAP, _ENUM_FMT, _G_FMT, _S_FMT = 0x80685600, 0xC0405602, 0xC0D05604, 0xC0D05605
_REQBUFS, _QUERYBUF, _QBUF, _DQBUF = 0xC0145608, 0xC0585609, 0xC058560F, 0xC0585611
_STREAMON, _STREAMOFF, _G_PARM, _S_PARM = 0x40045612, 0x40045613, 0xC0CC5615, 0xC0CC5616
_G_CTRL, _S_CTRL, _QUERYCTRL = 0xC008561B, 0xC008561C, 0xC0445624
_ENUM_SIZES, _ENUM_INTERVALS, _UVC_QUERY = 0xC02C564A, 0xC034564B, 0xC0107521
_CAPTURE_AND_STREAMING, _METADATA, _HAS_DEVICE_CAPS = 0x04200001, 0x04A00000, 0x80000000
PAGE = 4096
# The value of the first must be the third, or the second cannot be set.
_GUARDS = {EXPOSURE: (AUTO_EXPOSURE, 1), WHITE_BALANCE: (AUTO_WHITE_BALANCE, 0)}


def system_error(number: int) -> OSError:
    """The error of a system call."""
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
    # The first number refers to the whole device, the second to this node.
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
        raise system_error(errno.EINVAL)
    return values[index]


def _get_format(device: VideoDevice, fd: int, view: memoryview) -> None:
    struct.pack_into(
        "<II4sIIII",
        view,
        8,
        device.width,
        device.height,
        _fourcc(device.pixel_format),
        1,
        device.row_bytes,
        device.picture_bytes,
        8,
    )


def _set_format(device: VideoDevice, fd: int, view: memoryview) -> None:
    if device.buffers:
        raise system_error(errno.EBUSY)
    width, height, name = struct.unpack_from("<II4s", view, 8)
    device.pixel_format = name.decode() if name.decode() in device.formats else next(iter(device.formats))
    sizes = device.formats[device.pixel_format]
    device.width, device.height = min(sizes, key=lambda size: abs(size[0] - width) + abs(size[1] - height))
    _get_format(device, fd, view)


def _get_rate(device: VideoDevice, fd: int, view: memoryview) -> None:
    struct.pack_into("<IIII", view, 4, 0x1000, 0, 1000, round(device.rate * 1000))


def _set_rate(device: VideoDevice, fd: int, view: memoryview) -> None:
    if device.streaming:
        raise system_error(errno.EBUSY)
    numerator, denominator = struct.unpack_from("<II", view, 12)
    device.rate = min(device.rates, key=lambda rate: abs(rate - denominator / max(numerator, 1)))
    _get_rate(device, fd, view)


def _request_buffers(device: VideoDevice, fd: int, view: memoryview) -> None:
    count, kind, memory = struct.unpack_from("<III", view, 0)
    if (kind, memory) != (1, 1):
        raise system_error(errno.EINVAL)
    if device.streaming or device.owner not in (None, fd):
        raise system_error(errno.EBUSY)
    size = -(-device.picture_bytes // PAGE) * PAGE
    device.buffers = [FrameBuffer(bytearray(size)) for _ in range(min(count, 32))]
    device.queued.clear()
    device.done.clear()
    device.owner = fd if count else None
    struct.pack_into("<I", view, 0, len(device.buffers))


def _index(device: VideoDevice, view: memoryview) -> int:
    index, kind = struct.unpack_from("<II", view, 0)
    memory = struct.unpack_from("<I", view, 60)[0]
    if index >= len(device.buffers) or (kind, memory) != (1, 1):
        raise system_error(errno.EINVAL)
    return int(index)


def _query_buffer(device: VideoDevice, fd: int, view: memoryview) -> None:
    index = _index(device, view)
    struct.pack_into("<I", view, 64, index * PAGE)
    struct.pack_into("<I", view, 72, len(device.buffers[index].memory))


def _queue(device: VideoDevice, fd: int, view: memoryview) -> None:
    index = _index(device, view)
    if index in device.queued or index in device.done:
        raise system_error(errno.EINVAL)
    device.queued.append(index)


def _dequeue(device: VideoDevice, fd: int, view: memoryview) -> None:
    if not device.streaming:
        raise system_error(errno.EINVAL)
    if not device.done:
        raise system_error(errno.EAGAIN)
    index = device.done.popleft()
    buffer = device.buffers[index]
    struct.pack_into("<IIIII", view, 0, index, 1, buffer.used, buffer.flags, 1)
    struct.pack_into("<qq", view, 24, buffer.stamp_ns // 10**9, buffer.stamp_ns % 10**9 // 1000)
    struct.pack_into("<II", view, 56, buffer.sequence, 1)
    struct.pack_into("<I", view, 72, len(buffer.memory))


def _stream_on(device: VideoDevice, fd: int, view: memoryview) -> None:
    if not device.buffers or device.owner != fd:
        raise system_error(errno.EINVAL)
    device.streaming, device.sequence = True, 0
    if device.after_start:
        device.after_start(device)


def _stream_off(device: VideoDevice, fd: int, view: memoryview) -> None:
    if device.owner not in (None, fd):
        raise system_error(errno.EBUSY)
    device.streaming = False
    device.queued.clear()
    device.done.clear()


def _control(device: VideoDevice, view: memoryview) -> tuple[int, ControlState]:
    number = struct.unpack_from("<I", view, 0)[0]
    if number not in device.controls:
        raise system_error(errno.EINVAL)
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
        raise system_error(errno.EACCES)
    value = min(max(struct.unpack_from("<i", view, 4)[0], control.minimum), control.maximum)
    if not control.stuck:
        control.value = control.minimum + (value - control.minimum) // control.step * control.step


def _extension(device: VideoDevice, fd: int, view: memoryview) -> None:
    if device.extension is None:
        raise system_error(errno.ENOENT)
    unit, selector, query, size, address = struct.unpack_from("<BBBxHxxQ", view, 0)
    data = bytearray(ctypes.string_at(address, size))
    device.extension(unit, selector, query, data)
    ctypes.memmove(address, bytes(data), size)


ANSWERS: dict[int, Callable[[VideoDevice, int, memoryview], None]] = {
    _QUERYCAP: _querycap, _ENUM_FMT: _enum_format, _G_FMT: _get_format, _S_FMT: _set_format, _REQBUFS: _request_buffers,
    _QUERYBUF: _query_buffer, _QBUF: _queue, _DQBUF: _dequeue, _STREAMON: _stream_on, _STREAMOFF: _stream_off,
    _G_PARM: _get_rate, _S_PARM: _set_rate, _G_CTRL: _get_control, _S_CTRL: _set_control, _QUERYCTRL: _query_control,
    _ENUM_SIZES: _enum_sizes, _ENUM_INTERVALS: _enum_intervals, _UVC_QUERY: _extension,
}  # fmt: skip
