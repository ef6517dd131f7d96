"""Access control of a link: answers ZeroMQ's authentication requests (ZAP, ZeroMQ RFC 27) and logs refusals."""

from __future__ import annotations

import sys
import time
from typing import Any

import zmq
from zmq.utils import z85

from nodes.linking.keys import DRIVE, WATCH, KeyFolder

_REPEAT_S = 10.0
_ZAP_FRAMES = 7


class RefusalLog:
    """Counts refusals and logs each at most once in ten seconds, so that repeated attempts cannot fill the disk.

    Attributes:
        refused: Number of refused handshakes and messages.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._said: dict[str, float] = {}

    def refuse(self, what: str) -> None:
        """Count and log a refusal."""
        self.refused += 1
        self.say(f"refused {what}")

    def say(self, what: str) -> None:
        """Write one line to the node's log."""
        now = time.monotonic()
        if now - self._said.get(what, -_REPEAT_S) < _REPEAT_S:
            return
        if len(self._said) > 1000:
            self._said.clear()
        self._said[what] = now
        print(f"link: {what}", file=sys.stderr, flush=True)


class Doorkeeper:
    """Admits the keys that are on the allow-lists on disk at that moment.

    Args:
        context: The ZeroMQ context whose connections it authenticates.
        keys: Key folder with the lists.
        log: Log of refusals.
    """

    def __init__(self, context: zmq.Context[Any], keys: KeyFolder, log: RefusalLog) -> None:
        self._keys, self._log = keys, log
        self._allowed = {right: keys.allowed(right) for right in (WATCH, DRIVE)}
        self.socket = context.socket(zmq.REP)
        self.socket.linger = 0
        self.socket.bind("inproc://zeromq.zap.01")

    def judge(self) -> None:
        """Answer one authentication request."""
        frames = self.socket.recv_multipart()
        user = self._user(frames) if len(frames) == _ZAP_FRAMES else ""
        request = frames[1] if len(frames) > 1 else b""
        self.socket.send_multipart([b"1.0", request, b"200" if user else b"400", b"", user.encode(), b""])

    def _user(self, frames: list[bytes]) -> str:
        """Name of the requesting key; empty if it is refused."""
        right, address = (frame.decode("ascii", "replace") for frame in frames[2:4])
        if frames[5] != b"CURVE" or right not in self._allowed:
            self._log.refuse(f"{address} at the {right} door: expected a CURVE key, got {frames[5]!r}")
            return ""
        public = z85.encode(frames[6]).decode("ascii")
        try:
            user = self._keys.allowed(right).get(public, "")
        except OSError as error:
            self._log.refuse(f"{address} at the {right} door: the list cannot be read: {error.strerror}")
            return ""
        if user:
            self._allowed[right][public] = user
        else:
            self._log.refuse(f"{address} at the {right} door: its key {public} is not on the list")
        return user

    def revoked(self) -> dict[str, list[str]]:
        """Names removed from a list since the last call, by list. Nobody, while descriptors or memory have run out."""
        gone = {}
        for right, before in self._allowed.items():
            try:
                now = self._keys.allowed(right)
            except OSError as error:
                self._log.say(
                    f"the list of those who may {right} cannot be read, and stays: {error.strerror}"
                )
                continue
            if names := [name for key, name in before.items() if key not in now]:
                gone[right] = names
            self._allowed[right] = now
        return gone
