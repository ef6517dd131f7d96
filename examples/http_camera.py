"""A camera of your own: a network camera that streams JPEG pictures over HTTP.

    .venv/bin/advnerf car camera check examples/http_camera.py:HttpCamera --set url=http://192.168.0.20:8080/stream

In a launch file: `source: {kind: ../examples/http_camera.py:HttpCamera, url: ...}`; see docs/cameras.md.
"""

from __future__ import annotations

import socket
import time
from urllib.parse import urlsplit

import cv2
import numpy as np

from advnerf_core.strict import StrictModel
from hardware.cameras.interface import Camera, Frame
from hardware.errors import DeviceNotFound, LinkLost

BEGIN, END = b"\xff\xd8", b"\xff\xd9"  # of a JPEG


class HttpCamera(Camera):
    """Reads the newest picture of a stream (`multipart/x-mixed-replace`), stamped when it arrives."""

    class Config(StrictModel):
        """Keys beside `kind`: the address of the stream."""

        url: str

    def __init__(self, config: Config) -> None:
        self._url = urlsplit(config.url)
        self._socket: socket.socket | None = None
        self._bytes, self._sequence = b"", 0

    def open(self) -> None:
        """Connect, and ask for the stream."""
        self.close()
        host, port = self._url.hostname or "", self._url.port or 80
        try:
            self._socket = socket.create_connection((host, port), timeout=2.0)
            self._socket.sendall(f"GET {self._url.path or '/'} HTTP/1.0\r\nHost: {host}\r\n\r\n".encode())
        except OSError as error:
            raise DeviceNotFound(f"expected a camera at {self._url.geturl()}, got: {error}") from error

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest picture, or None after `timeout_s`."""
        if self._socket is None:
            raise LinkLost(f"expected an open camera, {self._url.geturl()} is not open; call open() first")
        deadline = time.monotonic() + timeout_s
        while (end := self._bytes.rfind(END)) < 0:
            self._socket.settimeout(max(deadline - time.monotonic(), 1e-3))
            try:
                received = self._socket.recv(1 << 20)
            except TimeoutError:
                return None
            if not received:
                raise LinkLost(f"{self._url.geturl()} ended its stream; is it the right path?")
            self._bytes += received
        begin = self._bytes.rfind(BEGIN, 0, end)
        jpeg, self._bytes = self._bytes[begin : end + 2], self._bytes[end + 2 :]
        bgr = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        if bgr is None:
            raise LinkLost(f"{self._url.geturl()} sent a damaged picture")
        rgb = np.ascontiguousarray(bgr[:, :, ::-1], dtype=np.uint8)
        rgb.flags.writeable = False
        self._sequence += 1
        return Frame(rgb, time.time_ns(), time.monotonic_ns(), self._sequence)

    def close(self) -> None:
        """Disconnect."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._bytes = None, b""
