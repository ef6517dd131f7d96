"""A camera of your own: the pictures of a network camera that streams JPEG over HTTP.

    .venv/bin/advnerf camera check examples/camera_http.py:HttpCamera --set url=http://192.168.0.20:8080/stream

In a launch file: `source: {kind: ../examples/camera_http.py:HttpCamera, url: ...}`; see docs/cameras.md.
"""

from __future__ import annotations

import socket
import time
import urllib.request
from typing import Any

import cv2
import numpy as np
from pydantic import Field

from advnerf_core.strict import StrictModel
from hardware.cameras.interface import Camera, Frame
from hardware.errors import DeviceNotFound, LinkLost

START, END = b"\xff\xd8", b"\xff\xd9"  # of a JPEG


class HttpCamera(Camera):
    """Reads a stream of JPEGs (``multipart/x-mixed-replace``); a picture is stamped when it has arrived."""

    class Config(StrictModel):
        """Keys beside ``kind``: address of the stream, and longest time to wait for an answer [s]."""

        url: str
        connect_s: float = Field(default=2.0, gt=0.0)

    def __init__(self, config: Config) -> None:
        self._config = config
        self._stream: Any = None
        self._bytes, self._sequence = b"", 0

    def open(self) -> None:
        """Connect. The first picture may be an old one of the camera's buffer."""
        self.close()
        try:
            self._stream = urllib.request.urlopen(self._config.url, timeout=self._config.connect_s)
        except (OSError, ValueError) as error:
            raise DeviceNotFound(f"expected a camera at {self._config.url}, got: {error}") from error

    def read(self, timeout_s: float) -> Frame | None:
        """The newest picture that has arrived, or None after ``timeout_s``."""
        if self._stream is None:
            raise LinkLost(f"expected an open camera, but {self._config.url} is not open; call open() first")
        deadline = time.monotonic() + timeout_s
        while (jpeg := self._newest()) is None:
            if not self._receive(max(deadline - time.monotonic(), 1e-3)):
                return None
        pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        if pixels is None:
            return None
        rgb = np.ascontiguousarray(pixels[:, :, ::-1])
        rgb.flags.writeable = False
        self._sequence += 1
        return Frame(rgb, time.time_ns(), time.monotonic_ns(), self._sequence)

    def close(self) -> None:
        """Disconnect."""
        if self._stream is not None:
            self._stream.close()
        self._stream, self._bytes = None, b""
