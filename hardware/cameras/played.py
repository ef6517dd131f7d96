"""Common base of cameras that play a recording at a constant rate."""

from __future__ import annotations

import time
from abc import abstractmethod
from pathlib import Path
from typing import Any

import numpy as np

from hardware.cameras.interface import RECORDED, Camera, Frame
from hardware.errors import LinkLost


class PlayedCamera(Camera):
    """Delivers recorded images, stamped at their delivery.

    Args:
        loop: Start over after the last image. Otherwise the device is lost, like an unplugged camera.
    """

    def __init__(self, path: Path | str, loop: bool) -> None:
        self.path = Path(path)
        self._loop = loop
        self._period_s: float | None = None  # None while it is closed
        self._sequence = 0
        self._next_s = 0.0

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next image when it is due, or None after ``timeout_s``."""
        if self._period_s is None:
            raise LinkLost(f"expected an open camera, but {self.path} is not open; call open() first")
        wait_s = self._next_s - time.monotonic()
        if wait_s > timeout_s:
            time.sleep(timeout_s)
            return None
        time.sleep(max(wait_s, 0.0))
        rgb = np.ascontiguousarray(self._next_bgr()[:, :, ::-1], dtype=np.uint8)
        rgb.flags.writeable = False
        frame = Frame(rgb, time.time_ns(), time.monotonic_ns(), self._sequence)
        self._sequence += 1
        # Scheduled from the current time, so that images are never delivered in a burst.
        self._next_s = max(self._next_s + self._period_s, time.monotonic())
        return frame

    def counters(self) -> dict[str, float]:
        """Say that the frames are recorded: their stamps are of now, and a real car must not drive by them."""
        return {RECORDED: 1.0}

    def close(self) -> None:
        """Close the camera."""
        self._period_s = None

    def _begin(self, period_s: float) -> None:
        self._period_s, self._sequence, self._next_s = period_s, 0, time.monotonic()

    @abstractmethod
    def _next_bgr(self) -> Any:
        """Pixels ``[H, W, 3]`` of the next image.

        Raises:
            LinkLost: The source has ended, or the image cannot be decoded.
        """
