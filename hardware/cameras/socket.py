"""Camera that receives frames over a Unix socket, from `hardware.emulators.frame_server` or another frame server."""

from __future__ import annotations

import socket
import time
from pathlib import Path

from hardware.cameras.frame_wire import HEAD_BYTES, REQUEST, decode_frame, pixel_bytes
from hardware.cameras.interface import Camera, Frame
from hardware.errors import DeviceNotFound, LinkLost, LinkTimeout

# Time that a server on the same machine needs to answer if it has a frame.
_ANSWER_S = 0.01


class SocketCamera(Camera):
    """Reads frames with their capture stamps, which are kept.

    Each frame is requested, so that no frame waits in the socket while the reader is busy.

    Args:
        stall_s: Longest time for receiving a frame [s].
    """

    def __init__(self, path: Path | str, stall_s: float = 1.0) -> None:
        self.path = Path(path)
        self._stall_s = stall_s
        self._socket: socket.socket | None = None
        self._asked = False

    def open(self) -> None:
        """Connect to the server."""
        self.close()
        client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            client.connect(str(self.path))
        except OSError as error:
            client.close()
            raise DeviceNotFound(
                f"expected a frame server at {self.path}, got: {error.strerror or error}; is the twin, or the camera's server, running?"
            ) from error
        self._socket, self._asked = client, False

    def read(self, timeout_s: float) -> Frame | None:
        """Newest frame not read yet, or None after ``timeout_s``."""
        if not self._asked:
            self._ask()
        elif (frame := self._read_one(0.0)) is not None:
            # This answers a request that timed out earlier, so there may be a newer frame.
            self._ask()
            return self._read_one(_ANSWER_S) or frame
        return self._read_one(timeout_s)

    def close(self) -> None:
        """Disconnect."""
        if self._socket is not None:
            self._socket.close()
            self._socket, self._asked = None, False

    def _ask(self) -> None:
        if self._socket is None:
            raise LinkLost(f"expected an open camera, but {self.path} is not connected; call open() first")
        try:
            self._socket.sendall(REQUEST)
        except OSError as error:
            raise LinkLost(
                f"the frame server at {self.path} closed the connection: {error.strerror or error}"
            ) from error
        self._asked = True

    def _read_one(self, timeout_s: float) -> Frame | None:
        assert self._socket is not None
        self._socket.settimeout(timeout_s)
        try:
            first = self._socket.recv(1)
        except (TimeoutError, BlockingIOError):
            return None
        except OSError as error:
            raise LinkLost(f"lost the frame server at {self.path}: {error}") from error
        if not first:
            raise LinkLost(f"the frame server at {self.path} closed the connection")
        deadline = time.monotonic() + self._stall_s
        head = first + self._receive(HEAD_BYTES - 1, deadline)
        frame = decode_frame(head, self._receive(pixel_bytes(head), deadline))
        self._asked = False
        return frame

    def _receive(self, count: int, deadline: float) -> bytes:
        assert self._socket is not None
        buffer, filled = bytearray(count), 0
        view = memoryview(buffer)
        while filled < count:
            self._socket.settimeout(max(deadline - time.monotonic(), 1e-3))
            try:
                received = self._socket.recv_into(view[filled:])
            except TimeoutError as error:
                raise LinkTimeout(
                    f"expected a complete frame from {self.path} within {self._stall_s} s, got {filled} of {count} bytes"
                ) from error
            except OSError as error:
                raise LinkLost(f"lost the frame server at {self.path}: {error}") from error
            if received == 0:
                raise LinkLost(
                    f"the frame server at {self.path} closed the connection in the middle of a frame"
                )
            filled += received
        return bytes(buffer)
