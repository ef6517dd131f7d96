"""Requests of a node to the safety node, repeated until they are answered. Pure: times come as arguments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nodes.runtime.arm_requests import ARM, BRAKE_WAIT_S, OPERATOR, arm_message
from nodes.runtime.clock import NS_PER_S, Now
from nodes.runtime.node import Out
from nodes.runtime.requests import RequestIdentity
from nodes.runtime.wire import MessageInfo

# A request to arm is void after this time; a request to disarm is repeated until it is answered.
_ARM_NS = NS_PER_S


@dataclass
class _Pending:
    asked: RequestIdentity
    arm: bool
    reason: str


class ArmAsker:
    """Repeats one request to arm or to disarm at every tick. A request to disarm replaces one to arm.

    A request to disarm is confirmed when the safety node has answered it and the motor node has reported since then that it brakes.

    Attributes:
        stops_asked: Number of requests to disarm.
        stops_confirmed: Value of `stops_asked` at the last confirmation.
    """

    def __init__(self) -> None:
        self._pending: _Pending | None = None
        self._answered_ns: int | None = None
        self.stops_asked = self.stops_confirmed = 0

    def arm(self, now: Now, reason: str) -> None:
        """Ask to arm, unless a request to disarm is not answered yet."""
        if self._pending is None or self._pending.arm:
            self._pending = _Pending(RequestIdentity.at(now), True, reason)

    def disarm(self, now: Now, reason: str) -> Out:
        """Ask to disarm. Returns the first message."""
        self._pending = _Pending(RequestIdentity.at(now), False, reason)
        self.stops_asked += 1
        self._answered_ns = None
        return self._message(self._pending, now)

    def heard(self, message: Any, info: MessageInfo) -> None:
        """Note a state of the safety node, which may answer the request."""
        if self._pending is not None and message.answered_id == self._pending.asked.ask_id:
            if not self._pending.arm:
                self._answered_ns = info.publish_mono_ns
            self._pending = None
        elif message.armed:
            self._answered_ns = None  # another request has armed the car since

    def heard_motor(self, message: Any, info: MessageInfo) -> None:
        """Note a report of the motor node, which may show that the car brakes."""
        if self._answered_ns is not None and message.braking and info.publish_mono_ns >= self._answered_ns:
            self._answered_ns, self.stops_confirmed = None, self.stops_asked

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

    def not_confirmed(self, now: Now) -> str:
        """Why the car may not have stopped; empty without a request, after its confirmation, and in the first 0.3 s."""
        if (waited_s := self.unanswered_s(now)) > BRAKE_WAIT_S:
            return (
                f"NOT CONFIRMED: no answer from the safety node for {waited_s:.1f} s. Use the hardware stop"
            )
        if self._answered_ns is not None and now.mono_ns - self._answered_ns > BRAKE_WAIT_S * NS_PER_S:
            return "NOT CONFIRMED: disarmed, but the motor node does not report that it brakes. Watch the car"
        return ""

    @staticmethod
    def _message(pending: _Pending, now: Now) -> Out:
        return Out(ARM, arm_message(pending.asked, now, pending.arm, OPERATOR, pending.reason))
