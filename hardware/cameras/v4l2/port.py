"""Interface of the system calls of a video device, implemented by the kernel, and by an emulator for tests and the twin."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import mmap
import os
import select
from pathlib import Path
from typing import Any, Protocol

from hardware.errors import DeviceBusy, DeviceNotFound, HardwareError, LinkLost, ProtocolError

BY_ID = Path("/dev/v4l/by-id")


class VideoPort(Protocol):
    """System calls that the drivers need. Every failure is an `OSError` with the kernel's error number."""

    def open(self, path: Path) -> int:
        """Open a device for reading and writing, without blocking."""
        ...

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes._SimpleCData[Any]) -> None:
        """One request; the argument is read and written in place."""
        ...

    def map(self, fd: int, length: int, offset: int) -> Any:
        """Map a buffer of the device [bytes]; the result is an object with the buffer interface and ``close()``."""
        ...

    def wait(self, fd: int, timeout_s: float) -> bool:
        """Wait until a frame can be taken; ENODEV if the device has gone."""
        ...

    def close(self, fd: int) -> None:
        """Close the device."""
        ...

    def names(self) -> list[str]:
        """Stable paths of the existing devices, for messages."""
        ...


class KernelPort:
    """The kernel."""

    def open(self, path: Path) -> int:
        """See `VideoPort`."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes._SimpleCData[Any]) -> None:
        """See `VideoPort`."""
        while True:
            try:
                fcntl.ioctl(fd, request, argument, True)
                return
            except InterruptedError:
                continue

    def map(self, fd: int, length: int, offset: int) -> mmap.mmap:
        """See `VideoPort`."""
        return mmap.mmap(fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)

    def wait(self, fd: int, timeout_s: float) -> bool:
        """See `VideoPort`."""
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        events = poll.poll(max(timeout_s, 0.0) * 1e3)
        if events and not events[0][1] & select.POLLIN:
            # Error or hang-up without a frame: unplugged. Asking again would spin.
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
        return bool(events)

    def close(self, fd: int) -> None:
        """See `VideoPort`."""
        os.close(fd)

    def names(self) -> list[str]:
        """See `VideoPort`."""
        stable = sorted(str(path) for path in BY_ID.glob("*")) if BY_ID.is_dir() else []
        return stable or sorted(str(path) for path in Path("/dev").glob("video*"))


def open_device(port: VideoPort, path: Path) -> int:
    """Open a device. Raises an error in one sentence if it cannot be opened."""
    try:
        return port.open(path)
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ENOTDIR):
            there = ", ".join(port.names()) or "none"
            raise DeviceNotFound(
                f"expected a camera at {path}, found none; video devices here: {there}. Is it plugged in?"
            ) from error
        if error.errno in (errno.EACCES, errno.EPERM):
            raise HardwareError(
                f"no permission to open {path}; add your user to the group 'video' and log in again"
            ) from error
        raise _translated(error, path, "opening") from error


def request(port: VideoPort, fd: int, path: Path, number: int, argument: Any, doing: str) -> None:
    """Send a request. Raises a `HardwareError` that names the device and the action if it fails."""
    try:
        port.ioctl(fd, number, argument)
    except OSError as error:
        raise _translated(error, path, doing) from error


def _translated(error: OSError, path: Path, doing: str) -> HardwareError:
    reason = error.strerror or str(error)
    if error.errno in (errno.ENODEV, errno.EIO, errno.ENXIO, errno.ESHUTDOWN, errno.EPIPE, errno.EPROTO):
        return LinkLost(
            f"lost the camera {path} while {doing}: {reason}; unplugged, or not enough power or USB bandwidth?"
        )
    if error.errno == errno.EBUSY:
        return DeviceBusy(
            f"{path} is in use by another program ({doing}); find it with 'fuser {path}' and close it"
        )
    if error.errno in (errno.EINVAL, errno.ENOTTY, errno.ERANGE, errno.EACCES, errno.EBADF):
        return ProtocolError(f"{path} does not do what was asked ({doing}): {reason}")
    if error.errno in (errno.ENOSPC, errno.ENOMEM):
        return HardwareError(
            f"not enough USB bandwidth or memory for {path} ({doing}): {reason}; use another USB port, a lower rate, or MJPG"
        )
    return LinkLost(f"lost the camera {path} while {doing}: {reason}")
