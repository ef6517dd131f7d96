"""Camera that plays a recorded video at a constant rate, frame by frame."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hardware.cameras.interface import Camera, Frame
from hardware.errors import DeviceNotFound, LinkLost


class VideoCamera(Camera):
    """Delivers the frames of a video file, stamped at their delivery instead of with the time in the video.

    Args:
        path: The file, in a format that OpenCV's FFmpeg reads.
        rate_hz: Frame rate; None uses that of the file [Hz].
        loop: Start over after the last frame. Otherwise the device is lost, like an unplugged camera.
    """

    def __init__(self, path: Path | str, rate_hz: float | None = None, loop: bool = True) -> None:
        if rate_hz is not None and not rate_hz > 0.0:
            raise ValueError(f"expected a rate > 0 Hz, got {rate_hz}")
        self.path = Path(path)
        self._rate_hz = rate_hz
        self._loop = loop
        self._video: Any = None
        self._period_s = 0.0
        self._sequence = 0
        self._next_s = 0.0

    def open(self) -> None:
        """Open the file at its beginning."""
        self.close()
        if not self.path.is_file():
            raise DeviceNotFound(f"expected a video at {self.path}, found none; correct the path")
        video = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        own_hz = video.get(cv2.CAP_PROP_FPS) if video.isOpened() else 0.0
        if not video.isOpened() or not (self._rate_hz or 0.0 < own_hz < 1000.0):
            video.release()
            raise DeviceNotFound(
                f"expected a video, cannot read {self.path}; convert it, for example to MP4 with H.264"
            )
        self._video, self._period_s = video, 1.0 / (self._rate_hz or own_hz)
        self._sequence, self._next_s = 0, time.monotonic()

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame when it is due, or None after ``timeout_s``."""
        if self._video is None:
            raise LinkLost(f"expected an open camera, but {self.path} is not open; call open() first")
        wait_s = self._next_s - time.monotonic()
        if wait_s > timeout_s:
            time.sleep(timeout_s)
            return None
        time.sleep(max(wait_s, 0.0))
        taken, bgr = self._video.read()
        if not taken and self._loop and self._sequence > 0:
            self._video.set(cv2.CAP_PROP_POS_FRAMES, 0)
            taken, bgr = self._video.read()
        if not taken:
            raise LinkLost(f"all {self._sequence} frames of {self.path} were played; set loop to repeat them")
        rgb = np.ascontiguousarray(bgr[:, :, ::-1], dtype=np.uint8)
        rgb.flags.writeable = False
        frame = Frame(rgb, time.time_ns(), time.monotonic_ns(), self._sequence)
        self._sequence += 1
        # Scheduled from the current time, so that frames are never delivered in a burst.
        self._next_s = max(self._next_s + self._period_s, time.monotonic())
        return frame

    def close(self) -> None:
        """Close the file."""
        if self._video is not None:
            self._video.release()
            self._video = None
