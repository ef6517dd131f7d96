"""Runs a simulator in a separate process and environment: starts it, calls it, and ends it in every case.

The other end is ``hardware/worlds/servers/serve.py``, which also describes the messages. Every call has a deadline. A process that was
killed, hangs, is late, or sends anything but the answer to the question is ended at once, and the call raises a named error.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import signal
import subprocess
import tempfile
import time
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import zmq
from numpy.typing import NDArray

from hardware.worlds.remote_errors import (
    ServerLost,
    ServerProtocolError,
    ServerTimeout,
    ServerVersionError,
    SimulatorError,
)

PROTOCOL = 1
Arrays = Mapping[str, NDArray[Any]]
SERVERS = Path(__file__).parent / "servers"
_DTYPES = ("|u1", "<f4", "<f8")
_LARGEST_BYTES = 64 * 2**20
# Calls before any drive.
_BEFORE = ("hello", "open")
_LOOK_MS, _ENDING_S, _STARTING_S = 50, 2.0, 60.0
_TOLD_LINES = 3


@dataclass(frozen=True, eq=False)
class ServerReply:
    """The answer of a server.

    Attributes:
        result: JSON data.
        arrays: Arrays by name; writable.
    """

    result: dict[str, Any]
    arrays: dict[str, NDArray[Any]]


class RemoteServer:
    """The process of one simulator.

    Args:
        python: Interpreter of the simulator's environment.
        simulator: The simulator's file, which ``serve.py`` loads.
        server: Server script; another one than ``serve.py`` only in tests.
        starting_s: Deadline of the first answer, which needs no simulator [s].

    Raises:
        ServerLost: The process does not start.
        ServerTimeout: The server does not answer in time.
        ServerVersionError: The server uses another version of the protocol.

    Attributes:
        process: The process.
    """

    def __init__(
        self,
        name: str,
        python: Path,
        simulator: Path,
        server: Path = SERVERS / "serve.py",
        starting_s: float = _STARTING_S,
    ) -> None:
        self.name, self._sequence = name, 0
        # The folder, and so the socket in it, is accessible to this user only.
        self._folder = Path(tempfile.mkdtemp(prefix="advnerf-world-"))
        self._log = self._folder / "log"
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.PAIR)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, _LARGEST_BYTES)
        endpoint = f"ipc://{self._folder}/socket"
        self._socket.bind(endpoint)
        try:
            self.process = self._start([str(python), "-I", str(server), str(simulator), endpoint])
        except OSError as error:
            _end(None, self._context, self._folder)
            raise ServerLost(
                f"world {name}: expected to start {python}, got: {error}; run `advnerf scene world install {name}` again"
            ) from error
        self._end = weakref.finalize(self, _end, self.process, self._context, self._folder)
        self.call("hello", {}, {}, starting_s)

    def _start(self, command: Sequence[str]) -> subprocess.Popen[bytes]:
        with self._log.open("wb") as log:
            # A separate session: Ctrl-C reaches the client only, which ends the server with all that it started.
            return subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                cwd=self._folder,
                start_new_session=True,
            )

    def call(self, name: str, arguments: Mapping[str, Any], arrays: Arrays, deadline_s: float) -> ServerReply:
        """Call the simulator and wait for the answer.

        Args:
            arrays: Arrays by name: uint8, float32 or float64.
            deadline_s: Largest time until the answer [s].

        Raises:
            RemoteWorldError: One of `hardware.worlds.remote_errors`; the process was ended.
        """
        try:
            return self._call(name, arguments, arrays, deadline_s)
        except BaseException:
            # Also after Ctrl-C: an outstanding answer would be taken for the answer to the next question.
            self.kill()
            raise

    def close(self) -> None:
        """Ask the process to end, and end it if it does not; safe to call twice."""
        self._end()

    def kill(self) -> None:
        """End the process at once; safe to call twice."""
        _kill_all(self.process)
        self.close()

    def _call(
        self, name: str, arguments: Mapping[str, Any], arrays: Arrays, deadline_s: float
    ) -> ServerReply:
        if not self._end.alive:
            raise ServerLost(
                f"world {self.name}: its process was ended; reset the world to start another one"
            )
        self._sequence += 1
        frames = [np.ascontiguousarray(array) for array in arrays.values()]
        listed = [
            [key, frame.dtype.str, list(frame.shape)] for key, frame in zip(arrays, frames, strict=True)
        ]
        header = {"protocol": PROTOCOL, "sequence": self._sequence, "call": name}
        head = json.dumps({**header, "arguments": dict(arguments), "arrays": listed}).encode()
        end_s = time.monotonic() + deadline_s
        try:
            self._socket.send_multipart([head, *(frame.tobytes() for frame in frames)], flags=zmq.NOBLOCK)
        except zmq.Again:
            # Before the server has connected there is no peer to send to.
            self._wait(name, zmq.POLLOUT, end_s, deadline_s)
            self._socket.send_multipart([head, *(frame.tobytes() for frame in frames)])
        self._wait(name, zmq.POLLIN, end_s, deadline_s)
        return self._read(name, self._socket.recv_multipart())

    def _wait(self, name: str, event: int, end_s: float, deadline_s: float) -> None:
        """Wait until the socket is ready, the process ends, or time is up."""
        while True:
            left_ms = math.ceil(1e3 * (end_s - time.monotonic()))
            ended = self.process.poll() is not None
            if self._socket.poll(max(0, min(_LOOK_MS, left_ms)), event):
                return
            if ended:
                spoiled = "" if name in _BEFORE else "; the drive does not count, run it again"
                raise ServerLost(
                    f"world {self.name}: expected an answer to {name}, got the end of its process "
                    f"({_how(self.process.returncode)}){self._said()}{spoiled}"
                )
            if left_ms <= 0:
                raise ServerTimeout(
                    f"world {self.name}: expected an answer to {name} within {deadline_s:g} s, got none; its process hung or is too slow and was "
                    f"ended{self._said()}; raise the deadlines in the section world.server if it is slow"
                )

    def _read(self, name: str, message: list[bytes]) -> ServerReply:
        header = self._header(name, message[0])
        if header.get("protocol") != PROTOCOL:
            raise ServerVersionError(
                f"world {self.name}: expected version {PROTOCOL} of the protocol, got {header.get('protocol')!r:.40}; use the serve.py of this advnerf"
            )
        if header.get("sequence") != self._sequence:
            self._refuse(name, f"answer {self._sequence}", f"answer {header.get('sequence')!r:.40}")
        if "error" in header:
            raise SimulatorError(f"world {self.name}: {name}: {str(header['error'])[:500]}{self._said()}")
        if not isinstance(header.get("result"), dict):
            self._refuse(name, "a result", f"{header.get('result')!r:.80}")
        return ServerReply(header["result"], self._arrays(name, header.get("arrays"), message[1:]))

    def _header(self, name: str, head: bytes) -> dict[str, Any]:
        try:
            header = json.loads(head)
        except (ValueError, RecursionError):
            header = None
        if not isinstance(header, dict):
            self._refuse(name, "a header of JSON", f"{len(head)} bytes {head[:24]!r}")
        return header

    def _arrays(self, name: str, listed: Any, frames: list[bytes]) -> dict[str, NDArray[Any]]:
        if not isinstance(listed, list) or len(listed) != len(frames):
            count = len(listed) if isinstance(listed, list) else "none"
            self._refuse(name, "as many arrays as frames", f"{count} arrays and {len(frames)} frames")
        found = {}
        for entry, frame in zip(listed, frames, strict=True):
            try:
                key, dtype, shape = entry
                sizes = [int(size) for size in shape]
                fits = isinstance(key, str) and dtype in _DTYPES and min([*sizes, 1]) >= 0
                fits = fits and math.prod(sizes) * np.dtype(dtype).itemsize == len(frame)
            except (TypeError, ValueError, OverflowError):
                fits = False
            if not fits:
                self._refuse(
                    name, "arrays of bytes that fit type and shape", f"{entry!r:.80} with {len(frame)} bytes"
                )
            found[key] = np.frombuffer(frame, dtype).reshape(sizes).copy()
        return found

    def _refuse(self, name: str, expected: str, got: str) -> NoReturn:
        raise ServerProtocolError(
            f"world {self.name}: expected {expected} to {name}, got {got}; its process was ended; use the serve.py of this advnerf"
        )

    def _said(self) -> str:
        """The end of the process's output, for messages."""
        with contextlib.suppress(OSError):
            lines = self._log.read_bytes()[-4000:].decode("utf-8", "replace").strip().splitlines()
            if lines:
                return f"; it said: {' | '.join(line.strip()[:200] for line in lines[-_TOLD_LINES:])}"
        return ""


def _end(process: subprocess.Popen[bytes] | None, context: zmq.Context[Any], folder: Path) -> None:
    """End the process, gracefully if it listens, and free its resources."""
    if process is not None:
        if process.stdin is not None:
            with contextlib.suppress(OSError):
                process.stdin.close()  # the server takes this as the request to end
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_ENDING_S)
        _kill_all(process)
    context.destroy(linger=0)
    shutil.rmtree(folder, ignore_errors=True)


def _kill_all(process: subprocess.Popen[bytes]) -> None:
    """Kill a process with all that it started; it leads its own session."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _how(code: int) -> str:
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
