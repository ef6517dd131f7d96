"""Driver of cameras with Linux's video interface (USB webcams, the ZED as a UVC device, vivid, v4l2loopback), without OpenCV capture.

Buffers are mapped, and frames have the kernel's capture stamp and sequence number. A reader gets the newest frame or none; older
waiting frames are returned to the driver.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hardware.cameras.interface import Camera, Frame
from hardware.cameras.pixels import PixelLayout, to_rgb
from hardware.cameras.stamping import NS_PER_S, Decimator, Stamper
from hardware.cameras.v4l2 import abi
from hardware.cameras.v4l2 import controls as v4l2_controls
from hardware.cameras.v4l2.controls import Controls
from hardware.cameras.v4l2.negotiation import Identity, Mode, agree, identify
from hardware.cameras.v4l2.port import KernelPort, VideoPort, open_device, request
from hardware.errors import LinkLost, ProtocolError

_BUFFERS = 4


class V4l2Camera(Camera):
    """A video device.

    Args:
        path: Device path. ``/dev/v4l/by-id/...`` stays the same when the camera is plugged in again.
        mode: Mode that the device must deliver. Other modes are refused.
        controls: Controls to fix.
        rate_hz: Rate of delivered frames, chosen by their stamps; None for all [Hz].
        columns: First and one past the last column to deliver; None for all.
        size: Width and height to which the images are scaled [px]; None keeps their size.
        skip_frames: Number of frames to skip after the start, which are damaged or badly exposed on many devices.
        port: System calls.
        started: Called with the file descriptor when the stream runs, for device-specific settings.

    Attributes:
        identity: Identity reported by the device, once it is open.
    """

    def __init__(
        self,
        path: Path | str,
        mode: Mode,
        controls: Controls | None = None,
        rate_hz: float | None = None,
        columns: tuple[int, int] | None = None,
        size: tuple[int, int] | None = None,
        skip_frames: int = 1,
        port: VideoPort | None = None,
        started: Callable[[int], None] | None = None,
    ) -> None:
        self.path = Path(path)
        self.mode = mode
        self.identity: Identity | None = None
        self._controls = controls or Controls()
        self._decimator = None if rate_hz is None else Decimator(rate_hz, mode.fps)
        self._columns = columns
        self._size = size
        self._skip_frames = skip_frames
        self._port: VideoPort = port or KernelPort()
        self._started = started
        self._stamper = Stamper()
        self._fd: int | None = None
        self._layout: PixelLayout | None = None
        self._maps: list[Any] = []
        self._to_skip = 0
        self._last_sequence: int | None = None
        self._counts = {"frames_lost": 0, "frames_damaged": 0, "frames_passed_over": 0}

    def open(self) -> None:
        """Set the mode and the controls, and start the stream."""
        self.close()
        self._fd = open_device(self._port, self.path)
        try:
            self.identity = identify(self._port, self._fd, self.path)
            self._layout = agree(self._port, self._fd, self.path, self.mode, self._columns)
            fixed = v4l2_controls.apply(self._port, self._fd, self.path, self._controls)
            self._map_buffers()
            self._request(abi.STREAMON, ctypes.c_int(abi.CAPTURE), "starting the stream")
            v4l2_controls.verify(self._port, self._fd, self.path, fixed)
            if self._started:
                self._started(self._fd)
        except BaseException:
            self.close()
            raise
        self._to_skip, self._last_sequence = self._skip_frames, None
        self._stamper.restart()
        if self._decimator:
            self._decimator.restart()

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest unread frame, or None after ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while True:
            if self._fd is None:
                raise LinkLost(f"expected an open camera, but {self.path} is not open; call open() first")
            try:
                ready = self._port.wait(self._fd, max(deadline - time.monotonic(), 0.0))
            except OSError as error:
                raise LinkLost(
                    f"lost the camera {self.path}: {error.strerror or error}; was it unplugged?"
                ) from error
            if not ready:
                return None
            if (frame := self._newest()) is not None:
                return frame
            if time.monotonic() >= deadline:
                return None

    def close(self) -> None:
        """Stop the stream and release the device."""
        if self._fd is None:
            return
        fd, self._fd = self._fd, None
        # The device may be gone. After any failure, the descriptor must still be closed.
        with contextlib.suppress(OSError):
            self._port.ioctl(fd, abi.STREAMOFF, ctypes.c_int(abi.CAPTURE))
        for mapped in self._maps:
            with contextlib.suppress(BufferError, OSError):
                mapped.close()
        self._maps = []
        with contextlib.suppress(OSError):
            self._port.ioctl(fd, abi.REQBUFS, abi.RequestBuffers(0, abi.CAPTURE, abi.MEMORY_MMAP))
        with contextlib.suppress(OSError):
            self._port.close(fd)

    def counters(self) -> dict[str, float]:
        """Counts of lost, damaged and skipped frames, and of rejected stamps."""
        stamps = {"stamps_replaced": self._stamper.replaced, "stamps_refused": self._stamper.refused}
        return {**self._counts, **stamps}

    def _request(self, number: int, argument: Any, doing: str) -> None:
        assert self._fd is not None
        request(self._port, self._fd, self.path, number, argument, doing)

    def _map_buffers(self) -> None:
        assert self._fd is not None
        asked = abi.RequestBuffers(_BUFFERS, abi.CAPTURE, abi.MEMORY_MMAP)
        self._request(abi.REQBUFS, asked, "asking for buffers")
        if asked.count < 2:
            raise ProtocolError(f"expected at least 2 buffers from {self.path}, got {asked.count}")
        for index in range(asked.count):
            buffer = self._buffer(index)
            self._request(abi.QUERYBUF, buffer, "asking where a buffer is")
            try:
                self._maps.append(self._port.map(self._fd, buffer.length, buffer.m.offset))
            except OSError as error:
                raise ProtocolError(
                    f"cannot map a buffer of {self.path}: {error.strerror or error}"
                ) from error
            self._request(abi.QBUF, self._buffer(index), "handing it a buffer")

    @staticmethod
    def _buffer(index: int = 0) -> abi.Buffer:
        return abi.Buffer(index=index, type=abi.CAPTURE, memory=abi.MEMORY_MMAP)

    def _newest(self) -> Frame | None:
        """Dequeue the waiting buffers, return all but the newest to the driver, and make a frame of the newest."""
        taken: list[abi.Buffer] = []
        while len(taken) < len(self._maps) and (buffer := self._dequeue()) is not None:
            self._count(buffer)
            taken.append(buffer)
        # With every buffer full the driver had to stop: even the newest is old, and the next one comes soon.
        starved = len(taken) == len(self._maps)
        keep = None if starved or not taken else taken.pop()
        for buffer in taken:
            self._give_back(buffer)
        if self._to_skip == 0:
            self._counts["frames_passed_over"] += len(taken)
        if keep is None:
            return None
        try:
            return self._frame(keep)
        finally:
            self._give_back(keep)

    def _dequeue(self) -> abi.Buffer | None:
        assert self._fd is not None
        buffer = self._buffer()
        try:
            self._port.ioctl(self._fd, abi.DQBUF, buffer)
        except BlockingIOError:
            return None
        except OSError as error:
            unplugged = error.errno in (errno.ENODEV, errno.EIO)
            hint = "was it unplugged?" if unplugged else "reopening it"
            raise LinkLost(f"lost the camera {self.path}: {error.strerror or error}; {hint}") from error
        return buffer

    def _give_back(self, buffer: abi.Buffer) -> None:
        self._request(abi.QBUF, self._buffer(buffer.index), "handing it a buffer")

    def _count(self, buffer: abi.Buffer) -> None:
        if self._last_sequence is not None and buffer.sequence > self._last_sequence:
            self._counts["frames_lost"] += buffer.sequence - self._last_sequence - 1
        self._last_sequence = buffer.sequence

    def _frame(self, buffer: abi.Buffer) -> Frame | None:
        assert self._layout is not None
        if self._to_skip > 0:
            self._to_skip -= 1
            return None
        stamps = self._stamper.convert(_stamp_ns(buffer))
        if stamps is None:
            return None
        sequence = int(buffer.sequence)
        if self._decimator is not None:
            slot = self._decimator.slot(stamps[1])
            if slot is None:
                return None
            sequence = slot
        data = np.frombuffer(self._maps[buffer.index], np.uint8, count=min(buffer.bytesused, buffer.length))
        try:
            if buffer.flags & abi.BUF_FLAG_ERROR:
                raise ValueError("the driver marked the frame as damaged")
            rgb = to_rgb(data, self._layout)
        except ValueError:
            self._counts["frames_damaged"] += 1
            return None
        return Frame(self._scaled(rgb), *stamps, sequence)

    def _scaled(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self._size is None or rgb.shape[1::-1] == self._size:
            return rgb
        small = cv2.resize(rgb, self._size, interpolation=cv2.INTER_AREA)
        small.flags.writeable = False
        return np.asarray(small, dtype=np.uint8)


def _stamp_ns(buffer: abi.Buffer) -> int | None:
    """Capture stamp of a buffer [ns]; None if the driver has none."""
    stamp = buffer.timestamp.tv_sec * NS_PER_S + buffer.timestamp.tv_usec * 1000
    return None if stamp == 0 else int(stamp)
