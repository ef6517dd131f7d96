"""Camera that plays numbered image files at a constant rate."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np

from hardware.cameras.interface import Camera, Frame
from hardware.errors import DeviceNotFound, LinkLost

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp")


class FileCamera(Camera):
    """Delivers the images of a folder in the order of their names.

    Args:
        folder: Folder of the images.
        rate_hz: Rate of frames [Hz].
        loop: Start over after the last image. Otherwise the device is lost, like an unplugged camera.
    """

    def __init__(self, folder: Path | str, rate_hz: float = 10.0, loop: bool = True) -> None:
        if not rate_hz > 0.0:
            raise ValueError(f"expected a rate > 0 Hz, got {rate_hz}")
        self.folder = Path(folder)
        self._period_s = 1.0 / rate_hz
        self._loop = loop
        self._files: list[Path] = []
        self._sequence = 0
        self._next_s = 0.0

    def open(self) -> None:
        """List the images."""
        self._files = sorted(p for p in self.folder.glob("*") if p.suffix.lower() in IMAGE_SUFFIXES)
        if not self._files:
            raise DeviceNotFound(
                f"expected images ({', '.join(IMAGE_SUFFIXES)}) in {self.folder}, found none"
            )
        self._sequence, self._next_s = 0, time.monotonic()

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next image when it is due, or None after ``timeout_s``."""
        if not self._files:
            raise LinkLost(f"expected an open camera, but {self.folder} is not open; call open() first")
        wait_s = self._next_s - time.monotonic()
        if wait_s > timeout_s:
            time.sleep(timeout_s)
            return None
        time.sleep(max(wait_s, 0.0))
        if self._sequence >= len(self._files) and not self._loop:
            raise LinkLost(
                f"all {len(self._files)} images of {self.folder} were played; set loop to repeat them"
            )
        path = self._files[self._sequence % len(self._files)]
        bgr = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if bgr is None:
            raise LinkLost(f"expected an image, cannot decode {path}; remove or replace it")
        rgb = np.ascontiguousarray(bgr[:, :, ::-1], dtype=np.uint8)
        rgb.flags.writeable = False
        frame = Frame(rgb, time.time_ns(), time.monotonic_ns(), self._sequence)
        self._sequence += 1
        # Scheduled from the current time, so that images are never delivered in a burst.
        self._next_s = max(self._next_s + self._period_s, time.monotonic())
        return frame

    def close(self) -> None:
        """Close the camera."""
        self._files = []
