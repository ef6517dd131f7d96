"""System calls on emulated video devices, for testing the V4L2 drivers.

Frames are dropped when no buffer is queued, an unplugged device answers ENODEV, and one that another program holds answers EBUSY.
"""

from __future__ import annotations

import ctypes
import errno
from pathlib import Path
from typing import Any

from tests.support.v4l2_device import VideoDevice
from tests.support.v4l2_requests import ANSWERS, PAGE, system_error


class VideoPortEmulator:
    """System calls on emulated devices; see `hardware.cameras.v4l2.port.VideoPort`.

    Args:
        devices: Devices by path.
    """

    def __init__(self, devices: dict[str, VideoDevice]) -> None:
        self.devices = devices
        self._open: dict[int, VideoDevice] = {}
        self._next_fd = 1000

    def open(self, path: Path) -> int:
        """Open a device that is plugged in."""
        device = self.devices.get(str(path))
        if device is None or not device.there:
            raise system_error(errno.ENOENT)
        self._next_fd += 1
        self._open[self._next_fd] = device
        return self._next_fd

    def ioctl(self, fd: int, request: int, argument: Any) -> None:
        """Answer one request in the bytes of its argument."""
        device = self._open.get(fd)
        if device is None:
            raise system_error(errno.EBADF)
        with device.condition:
            if not device.there:
                raise system_error(errno.ENODEV)
            answer = ANSWERS.get(request)
            if answer is None:
                raise system_error(errno.ENOTTY)
            answer(device, fd, memoryview(argument).cast("B"))

    def map(self, fd: int, length: int, offset: int) -> Any:
        """Map a buffer."""
        device = self._open[fd]
        index = offset // PAGE
        if offset % PAGE or index >= len(device.buffers) or length != len(device.buffers[index].memory):
            raise system_error(errno.EINVAL)
        return _mapping(device.buffers[index].memory)

    def wait(self, fd: int, timeout_s: float) -> bool:
        """Wait until a buffer is filled."""
        device = self._open[fd]
        with device.condition:
            device.condition.wait_for(lambda: device.done or not device.there, timeout_s)
            if not device.there or not device.streaming:
                raise system_error(errno.ENODEV)
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
        """Number of open descriptors."""
        return len(self._open)


def _mapping(memory: bytearray) -> Any:
    """Array over a device's memory, with the ``close`` that a mapping has."""
    kind = type("Mapping", (ctypes.c_uint8 * len(memory),), {"close": lambda self: None})
    return kind.from_buffer(memory)  # type: ignore[attr-defined]
