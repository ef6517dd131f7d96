"""One browser: what is sent to it, newest only, and what it says, checked.

Pictures are sent with credit: at most two are on their way, and a newer picture replaces one that still waits. So a slow link makes
pictures rarer and never older.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import time
from collections import OrderedDict, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from nodes.operator_page.pictures import Picture
from nodes.operator_page.said import STOPS, Act, Hold, PictureSeen, Stop, Take, Wants, read_said
from nodes.runtime.errors import MessageError, SecurityError

if TYPE_CHECKING:
    from starlette.websockets import WebSocket

_CREDIT = 2
_STAMPS_KEPT = 256
_MALFORMED_LIMIT = 100
# A page sends about 20 answers to beats and 30 acknowledged pictures a second, and a person no ten acts.
_RATE_HZ, _BURST = 120.0, 240.0
_ACT_RATE_HZ, _ACT_BURST = 10.0, 40.0


@dataclass(frozen=True)
class ClientAct:
    """An act of a browser, for the node.

    Attributes:
        client: Number of the connection.
        frame_ns: Capture stamp of the newest picture on its screen [ns]; 0 without one.
        picture_ns: When the node received that picture, monotonic [ns]; 0 without one.
        session: Public name of the browser's session.
        name: Name of the person of that session.
    """

    client: int
    address: str
    act: Act
    frame_ns: int
    picture_ns: int
    session: str = ""
    name: str = ""


@dataclass(frozen=True)
class Gone:
    """A browser has gone."""

    client: int


class Misuse(SecurityError):
    """A browser sent too much, or too many messages that a page does not send. Its connection is closed."""


class _Budget:
    """Lets through a number of messages a second, and a burst of them."""

    def __init__(self, rate_hz: float, burst: float) -> None:
        self._rate_hz, self._burst = rate_hz, burst
        self._left, self._paid_s = burst, time.monotonic()

    def pay(self, what: str) -> None:
        now_s = time.monotonic()
        self._left = min(self._burst, self._left + (now_s - self._paid_s) * self._rate_hz) - 1.0
        self._paid_s = now_s
        if self._left < 0.0:
            raise Misuse(f"more than {self._rate_hz:g} {what} a second")


class Client:
    """One connected browser. Only the server's thread uses it.

    Args:
        name: Name of its person. Taking control gives a new one.
    """

    def __init__(
        self, number: int, address: str, socket: WebSocket, session: str = "", name: str = ""
    ) -> None:
        self.number, self.address, self._socket, self.session = number, address, socket, session
        self.name = name
        self.key = secrets.token_hex(16)
        self.wants: frozenset[int] = frozenset()
        self.malformed = 0
        self._wake = asyncio.Event()
        self._beat: int | None = None
        self._state = ""
        self._answers: deque[str] = deque(maxlen=32)
        self._pictures: dict[int, Picture] = {}
        self._under_way: dict[int, int] = {}
        self._sent: OrderedDict[int, int] = OrderedDict()
        self._last_n = -1
        self._messages, self._acts = _Budget(_RATE_HZ, _BURST), _Budget(_ACT_RATE_HZ, _ACT_BURST)
        self._stops = {kind: _Budget(_ACT_RATE_HZ, _ACT_BURST) for kind in STOPS}

    def offer_beat(self, beat: int) -> None:
        """Send the number of a beat; one that still waits is skipped."""
        self._beat = beat
        self._wake.set()

    def offer_state(self, state: str) -> None:
        """Send the state; one that still waits is skipped."""
        self._state = state
        self._wake.set()

    def offer_picture(self, picture: Picture) -> None:
        """Send a picture if the page shows its channel; one that still waits is skipped."""
        if picture.channel in self.wants:
            self._pictures[picture.channel] = picture
            self._wake.set()

    def answer(self, answer: dict[str, Any]) -> None:
        """Send the answer to an act."""
        self._answers.append(json.dumps(answer))
        self._wake.set()

    async def send_for_ever(self) -> None:
        """Send what is offered, until the connection ends."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            if self._beat is not None:
                beat, self._beat = self._beat, None
                await self._socket.send_text(f'{{"t":"beat","beat":{beat}}}')
            while self._answers:
                await self._socket.send_text(self._answers.popleft())
            if self._state:
                state, self._state = self._state, ""
                await self._socket.send_text(state)
            await self._send_pictures()

    async def _send_pictures(self) -> None:
        for channel in list(self._pictures):
            if self._under_way.get(channel, 0) >= _CREDIT:
                continue
            picture = self._pictures.pop(channel)
            self._under_way[channel] = self._under_way.get(channel, 0) + 1
            self._sent[picture.stamp_ns] = picture.received_ns
            if len(self._sent) > _STAMPS_KEPT:
                self._sent.popitem(last=False)
            await self._socket.send_bytes(picture.packed())

    def hear(self, data: str | bytes) -> ClientAct | None:
        """Check a message. Returns an act for the node, or None.

        Raises:
            Misuse: The connection must be closed.
        """
        try:
            # A request to stop pays for nothing but itself: neither other messages nor other acts use up its share.
            if _is_stop(data) and isinstance(stop := read_said(data), Stop):
                self._stops[stop.t].pay("stops")
                return self._asked(stop)
            self._messages.pay("messages")
            return self._read(data)
        except MessageError as error:
            self.malformed += 1
            if self.malformed >= _MALFORMED_LIMIT:
                raise Misuse(f"{self.malformed} malformed messages; the last: {error}") from error
            self.answer({"t": "refused", "text": str(error)[:200]})
            return None

    def _read(self, data: str | bytes) -> ClientAct | None:
        said = read_said(data)
        if isinstance(said, Wants):
            self.wants = frozenset(said.c)
            return None
        if isinstance(said, Stop):
            return self._asked(said)
        if isinstance(said, PictureSeen):
            self._under_way[said.c] = max(0, self._under_way.get(said.c, 0) - 1)
            self._wake.set()
            return None
        if not secrets.compare_digest(said.key, self.key):
            raise MessageError("expected an act with the key of this connection")
        if said.n <= self._last_n:
            raise MessageError(f"expected an act with a number above {self._last_n}, got {said.n}")
        if said.frame != "0" and int(said.frame) not in self._sent:
            raise MessageError("expected the stamp of a picture that was sent to this page")
        self._last_n = said.n
        if not isinstance(said, Hold):
            self._acts.pay("acts")
        return self._asked(said)

    def _asked(self, act: Act) -> ClientAct:
        frame_ns = int(act.frame)
        received_ns = self._sent.get(frame_ns, 0)
        if isinstance(act, Take):
            self.name = act.name
        seen_ns = frame_ns if received_ns else 0
        return ClientAct(self.number, self.address, act, seen_ns, received_ns, self.session, self.name)


def _is_stop(data: str | bytes) -> bool:
    """Whether a message may be a request to stop. Cheap, because every message is asked."""
    return isinstance(data, str) and any(f'"{kind}"' in data for kind in STOPS)
