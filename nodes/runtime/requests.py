"""What a request to a node carries and how the node keeps its answers: acted upon once, however often it is repeated. Pure."""

from __future__ import annotations

import secrets
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

from nodes.runtime.clock import Now
from nodes.runtime.messages import stamp_ns
from nodes.runtime.wire import MessageInfo

_REMEMBERED = 256
_LONGEST_ID = 64


@dataclass(frozen=True)
class Asked:
    """Identity of one request, the same in each of its repeats.

    Attributes:
        ask_id: Its name.
        mono_ns: When it was first asked, monotonic clock of the sender [ns].
        real_ns: The same, CLOCK_REALTIME [ns].
    """

    ask_id: str
    mono_ns: int
    real_ns: int

    @classmethod
    def at(cls, now: Now) -> Asked:
        """A request that is asked now for the first time."""
        return cls(secrets.token_hex(8), now.mono_ns, now.real_ns)

    def age_ns(self, now: Now) -> int:
        """Time since it was first asked [ns]."""
        return max(0, now.mono_ns - self.mono_ns)


@dataclass(frozen=True)
class Answer:
    """What a node decided about a request.

    Attributes:
        ask_id: Of the request.
        granted: Whether the node did what was asked.
        text: Why not, or what it did.
    """

    ask_id: str = ""
    granted: bool = False
    text: str = ""


def is_id(ask_id: str) -> bool:
    """Whether a text can be the id of a request: 1 to 64 characters."""
    return 0 < len(ask_id) <= _LONGEST_ID


class Answers:
    """Remembers the answers of a node by the id of the request, so that a repeat gets the same answer and changes nothing.

    Args:
        limit: How many are remembered; the oldest are forgotten first.
    """

    def __init__(self, limit: int = _REMEMBERED) -> None:
        self._limit = limit
        self._answers: OrderedDict[str, Answer] = OrderedDict()
        self.last = Answer()

    def repeat(self, ask_id: str) -> bool:
        """Whether this request was decided before; its answer is then the last one again. A request without id never was."""
        known = self._answers.get(ask_id)
        if known is not None:
            self.last = known
        return known is not None

    def give(self, answer: Answer) -> Answer | None:
        """Keep a new answer; returns the one that was forgotten for it, if any."""
        self.last = answer
        if not is_id(answer.ask_id):
            return None
        self._answers[answer.ask_id] = answer
        return self._answers.popitem(last=False)[1] if len(self._answers) > self._limit else None


def asked_mono_ns(message: Any, info: MessageInfo) -> int:
    """When a request was first asked, on our monotonic clock [ns].

    Its publication is known on our clock, also behind a gateway; from there the sender's own clocks count back. Of its two clocks
    the one that makes the request older counts: a real-time clock that is set back makes nothing younger, and neither does a
    recording that is played again.
    """
    by_stamp_ns = info.publish_real_ns - stamp_ns(message)
    return info.publish_mono_ns - max(0, int(message.age_ns), by_stamp_ns)
