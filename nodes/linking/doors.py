"""The keeper of a link's doors: answers ZeroMQ's question who may pass (ZAP, ZeroMQ RFC 27), and says whom it refused."""

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
    """Counts refusals and says each at most once in ten seconds: a stranger who goes on trying must not fill the disk.

    Attributes:
        refused: Handshakes and messages that were refused.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._said: dict[str, float] = {}

    def refuse(self, what: str) -> None:
        """Count and say a refusal."""
        self.refused += 1
        self.say(f"refused {what}")

    def say(self, what: str) -> None:
        """One line into the node's log."""
        now = time.monotonic()
        if now - self._said.get(what, -_REPEAT_S) < _REPEAT_S:
            return
        if len(self._said) > 1000:
            self._said.clear()
        self._said[what] = now
        print(f"link: {what}", file=sys.stderr, flush=True)


class Doorkeeper:
    """Lets in the keys of the allow-lists, as they are on disk at that moment.

    Args:
        context: The context whose doors it keeps.
        keys: Key folder with the lists.
        log: Where refusals go.
    """

    def __init__(self, context: zmq.Context[Any], keys: KeyFolder, log: RefusalLog) -> None:
        self._keys, self._log = keys, log
        self._allowed = {right: keys.allowed(right) for right in (WATCH, DRIVE)}
        self.socket = context.socket(zmq.REP)
        self.socket.linger = 0
        self.socket.bind("inproc://zeromq.zap.01")

    def judge(self) -> None:
        """Answer one question: may this key pass this door?"""
        frames = self.socket.recv_multipart()
        user = self._user(frames) if len(frames) == _ZAP_FRAMES else ""
        request = frames[1] if len(frames) > 1 else b""
        self.socket.send_multipart([b"1.0", request, b"200" if user else b"400", b"", user.encode(), b""])

    def _user(self, frames: list[bytes]) -> str:
        """Name of the key that asks; empty if it may not pass."""
        right, address = (frame.decode("ascii", "replace") for frame in frames[2:4])
        if frames[5] != b"CURVE" or right not in self._allowed:
            self._log.refuse(f"{address} at the {right} door: expected a CURVE key, got {frames[5]!r}")
            return ""
        public = z85.encode(frames[6]).decode("ascii")
        user = self._keys.allowed(right).get(public, "")
        if user:
            self._allowed[right][public] = user
        else:
            self._log.refuse(f"{address} at the {right} door: its key {public} is not on the list")
        return user

    def revoked(self) -> dict[str, list[str]]:
        """Names taken off a list since the last call, by list."""
        gone = {}
        for right, before in self._allowed.items():
            now = self._keys.allowed(right)
            if names := [name for key, name in before.items() if key not in now]:
                gone[right] = names
            self._allowed[right] = now
        return gone
