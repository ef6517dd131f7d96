"""Camera that plays a recorded video at a constant rate, frame by frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2

from hardware.cameras.played import PlayedCamera
from hardware.errors import DeviceNotFound, LinkLost


class VideoCamera(PlayedCamera):
    """Delivers the frames of a video file, stamped at their delivery instead of with the time in the video.

    Args:
        path: The file, in a format that OpenCV's FFmpeg reads.
        rate_hz: Frame rate; None uses the file's [Hz].
        loop: Start over after the last frame. Otherwise the device is lost, like an unplugged camera.
    """

    def __init__(self, path: Path | str, rate_hz: float | None = None, loop: bool = True) -> None:
        super().__init__(path, loop)
        self._rate_hz = rate_hz
        self._video: Any = None

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
        self._video = video
        self._begin(1.0 / (self._rate_hz or own_hz))

    def close(self) -> None:
        """Close the file."""
        super().close()
        if self._video is not None:
            self._video.release()
            self._video = None

    def _next_bgr(self) -> Any:
        taken, bgr = self._video.read()
        if not taken and self._loop and self._sequence > 0:
            self._video.set(cv2.CAP_PROP_POS_FRAMES, 0)
            taken, bgr = self._video.read()
        if not taken:
            raise LinkLost(f"all {self._sequence} frames of {self.path} were played; set loop to repeat them")
        return bgr
