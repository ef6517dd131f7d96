"""Identity of requests to a node, and the answers that the node remembers. A repeated request is executed only once. Pure."""

from __future__ import annotations

import secrets
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

from nodes.runtime.clock import Now
from nodes.runtime.messages import stamp_ns
from nodes.runtime.wire import MessageInfo

# Reason of the safety node while an e-stop is latched, even if the car was stopped again since.
ESTOP_LATCHED = "e-stop pressed; release it and re-arm"
_REMEMBERED = 256
_LONGEST_ID = 64


@dataclass(frozen=True)
class RequestIdentity:
    """Identity of a request, which is the same in all its repeats.

    Attributes:
        mono_ns: Time of the first repeat, monotonic clock of the sender [ns].
        real_ns: Time of the first repeat, CLOCK_REALTIME [ns].
    """

    ask_id: str
    mono_ns: int
    real_ns: int

    @classmethod
    def at(cls, now: Now) -> RequestIdentity:
        """Make the identity of a request that is first sent now."""
        return cls(secrets.token_hex(8), now.mono_ns, now.real_ns)

    def age_ns(self, now: Now) -> int:
        """Time since the first repeat [ns]."""
        return max(0, now.mono_ns - self.mono_ns)


@dataclass(frozen=True)
class Answer:
    """Decision of a node about a request.

    Attributes:
        granted: Whether the node did what the request asked for.
        text: Action of the node, or its reason for refusing.
    """

    ask_id: str = ""
    granted: bool = False
    text: str = ""


def is_id(ask_id: str) -> bool:
    """Whether a text is a valid id of a request: 1 to 64 characters."""
    return 0 < len(ask_id) <= _LONGEST_ID


class AnswerMemory:
    """Remembers the answers of a node by request id. A repeat gets the same answer and has no further effect.

    Args:
        limit: Number of remembered answers; the oldest is forgotten first.
    """

    def __init__(self, limit: int = _REMEMBERED) -> None:
        self._limit = limit
        self._answers: OrderedDict[str, Answer] = OrderedDict()
        self.last = Answer()

    def repeat(self, ask_id: str) -> bool:
        """Whether this request was decided before. If so, its answer becomes the last one. A request without id never is."""
        known = self._answers.get(ask_id)
        if known is not None:
            self.last = known
        return known is not None

    def give(self, answer: Answer) -> Answer | None:
        """Store a new answer. Returns the answer that was forgotten for it, if any."""
        self.last = answer
        if not is_id(answer.ask_id):
            return None
        self._answers[answer.ask_id] = answer
        return self._answers.popitem(last=False)[1] if len(self._answers) > self._limit else None


def asked_mono_ns(message: Any, info: MessageInfo) -> int:
    """Time at which a request was first sent, on this host's monotonic clock [ns].

    The publication time is known on this host's clock, also behind a gateway. The sender's clocks give the time from the first repeat
    to this publication. Of its two clocks, the one that makes the request older is used. So neither a real-time clock that is set
    back nor a replayed recording makes a request younger.
    """
    by_stamp_ns = info.publish_real_ns - stamp_ns(message)
    return info.publish_mono_ns - max(0, int(message.age_ns), by_stamp_ns)
