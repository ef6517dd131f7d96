"""Serves the twin's frames on a Unix socket. A slow reader misses frames, never gets old ones, never delays them for others."""

from __future__ import annotations

import contextlib
import socket
import threading
from pathlib import Path

from hardware.cameras.frame_wire import REQUEST, encode_head
from hardware.cameras.interface import Frame
from hardware.emulators.unix_socket import listen


class FrameServer:
    """Sends every client the newest frame on request, or the next one if it has that already.

    Args:
        path: Path of the socket; a dead one from an earlier run is replaced, a live one is an error.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._newest: Frame | None = None
        self._condition = threading.Condition()
        self._stopping = False
        self._clients: set[socket.socket] = set()
        self._listener = listen(self.path, "a frame server")
        self._thread = threading.Thread(target=self._accept, name="frame server", daemon=True)
        self._thread.start()

    def publish(self, frame: Frame) -> None:
        """Offer a frame to all clients."""
        with self._condition:
            self._newest = frame
            self._condition.notify_all()

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        with self._condition:
            return len(self._clients)

    def close(self) -> None:
        """Disconnect all clients and remove the socket."""
        with self._condition:
            if self._stopping:
                return
            self._stopping = True
            clients = list(self._clients)
            self._condition.notify_all()
        for client in (self._listener, *clients):
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(timeout=2.0)
        self.path.unlink(missing_ok=True)

    def __enter__(self) -> FrameServer:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return  # closed
            with self._condition:
                self._clients.add(client)
                # A new client waits for the next frame: the last one may be old.
                last = self._newest
            threading.Thread(
                target=self._serve, args=(client, last), name="frame client", daemon=True
            ).start()

    def _serve(self, client: socket.socket, last: Frame | None) -> None:
        try:
            while client.recv(len(REQUEST)) and (frame := self._wait_for_newer(last)) is not None:
                client.sendall(encode_head(frame) + frame.rgb.tobytes())
                last = frame
        except OSError:
            pass  # the client left
        finally:
            with self._condition:
                self._clients.discard(client)
            client.close()

    def _wait_for_newer(self, last: Frame | None) -> Frame | None:
        with self._condition:
            while self._newest is last and not self._stopping:
                self._condition.wait()
            return None if self._stopping else self._newest
