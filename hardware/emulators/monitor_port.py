"""The plug of the simulated monitor: a Unix socket that takes pictures and reports the panel's content.

On connection it sends its EDID. ``S`` and ``height * width * 3`` bytes show a picture, answered by the SHA-256 of the shown
picture; ``R`` reads the shown pixels back. When the picture's source disconnects, the screen returns to idle, as a desktop does when a
window closes: a dead monitor node shows no attack.
"""

from __future__ import annotations

import contextlib
import hashlib
import socket
import threading
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hardware.emulators.unix_socket import listen
from hardware.screen.edid import make_edid

Rgb = NDArray[np.uint8]
SHOW, READ = b"S", b"R"
NATIVE_PX = (1920, 1080)
_IDLE = object()


class MonitorPort:
    """Serves one picture source at a time; a second one is disconnected.

    Args:
        path: Path of the socket; a dead one from an earlier run is replaced.
        size_m: Width and height of the panel [m].
        size_px: Native width and height [px].
    """

    def __init__(
        self, path: Path | str, size_m: tuple[float, float], size_px: tuple[int, int] = NATIVE_PX
    ) -> None:
        self.path, self.size_px = Path(path), size_px
        width_mm, height_mm = (round(1000.0 * side) for side in size_m)
        self._edid = make_edid("ADV", 1, "twin monitor", size_px, (width_mm, height_mm))
        self._lock = threading.Lock()
        self._next: object | Rgb | None = None  # not yet taken by the camera thread
        self._client: socket.socket | None = None
        self._listener = listen(self.path, "a simulated monitor", backlog=1)
        self._thread = threading.Thread(target=self._accept, name="twin monitor", daemon=True)
        self._thread.start()

    def take(self) -> tuple[bool, Rgb | None]:
        """Whether the screen has changed since the last call, and its current picture; None is the idle screen."""
        with self._lock:
            taken, self._next = self._next, None
        return taken is not None, taken if isinstance(taken, np.ndarray) else None

    def close(self) -> None:
        """Disconnect and remove the socket."""
        with self._lock:
            sockets = [self._listener, *([self._client] if self._client else [])]
        for each in sockets:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(timeout=2.0)
        self.path.unlink(missing_ok=True)

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return  # closed
            with self._lock:
                self._client = client
            try:
                self._serve(client)
            except OSError:
                pass  # it hung up in the middle
            finally:
                with self._lock:
                    self._next, self._client = _IDLE, None
                client.close()

    def _serve(self, client: socket.socket) -> None:
        width, height = self.size_px
        client.sendall(self._edid)
        shown: bytes = bytes(height * width * 3)
        while request := client.recv(1):
            if request == SHOW:
                pixels = receive_exactly(client, height * width * 3)
                if pixels is None:
                    return
                shown = pixels
                with self._lock:
                    self._next = np.frombuffer(shown, np.uint8).reshape(height, width, 3)
                client.sendall(hashlib.sha256(shown).digest())
            elif request == READ:
                client.sendall(shown)
            else:
                return  # not a picture source


def receive_exactly(source: socket.socket, count: int) -> bytes | None:
    """Receive exactly ``count`` bytes, or None if the other end closes the connection first."""
    data = bytearray()
    while len(data) < count:
        piece = source.recv(min(count - len(data), 1 << 20))
        if not piece:
            return None
        data += piece
    return bytes(data)
