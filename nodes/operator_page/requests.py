"""Requests of the page to the safety node, repeated until they are answered. Pure: times come as arguments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nodes.runtime.arm_requests import ARM, OPERATOR, arm_message
from nodes.runtime.clock import NS_PER_S, Now
from nodes.runtime.node import Out
from nodes.runtime.requests import Asked

# A request to arm is void after this time; a request to disarm is repeated until it is answered.
_ARM_NS = NS_PER_S


@dataclass
class _Pending:
    asked: Asked
    arm: bool
    reason: str


class ArmAsker:
    """Repeats one request to arm or to disarm at every tick. A request to disarm replaces one to arm."""

    def __init__(self) -> None:
        self._pending: _Pending | None = None

    def arm(self, now: Now, reason: str) -> None:
        """Ask to arm, unless a request to disarm is not answered yet."""
        if self._pending is None or self._pending.arm:
            self._pending = _Pending(Asked.at(now), True, reason)

    def disarm(self, now: Now, reason: str) -> Out:
        """Ask to disarm. Returns the first message."""
        self._pending = _Pending(Asked.at(now), False, reason)
        return self._message(self._pending, now)

    def heard(self, message: Any) -> None:
        """Note a state of the safety node, which may answer the request."""
        if self._pending is not None and message.answered_id == self._pending.asked.ask_id:
            self._pending = None

    def tick(self, now: Now) -> list[Out]:
        """Repeat the request."""
        pending = self._pending
        if pending is None:
            return []
        if pending.arm and pending.asked.age_ns(now) > _ARM_NS:
            self._pending = None
            return []
        return [self._message(pending, now)]

    def unanswered_s(self, now: Now) -> float:
        """Time for which a request to disarm has had no answer [s]; 0 without one."""
        pending = self._pending
        return 0.0 if pending is None or pending.arm else pending.asked.age_ns(now) / NS_PER_S

    @staticmethod
    def _message(pending: _Pending, now: Now) -> Out:
        return Out(ARM, arm_message(pending.asked, now, pending.arm, OPERATOR, pending.reason))
