"""Stop the cars of one or several runs, and know which of them have stopped.

A request to disarm is repeated until the safety node answers. It is confirmed when the motor node has reported since then that it
brakes. One run that does not answer delays no other.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from nodes.runtime.arm_requests import (
    ARM,
    BRAKE_WAIT_S,
    GATEWAY_STATUS,
    OPERATOR,
    SENT,
    STATE,
    ArmAnswer,
    arm_message,
    gateway_trouble,
)
from nodes.runtime.bus import Bus, Received
from nodes.runtime.clock import SystemClock
from nodes.runtime.errors import MessageError
from nodes.runtime.requests import RequestIdentity

_REPEAT_S = 0.02
_TELL_S = 1.0


@dataclass(frozen=True)
class StopReport:
    """Knowledge about the stop of one run.

    Attributes:
        waited_s: Time since the first request [s].
        answer: Answer of the safety node; None before it answers.
        trouble: Why the request cannot be sent; empty if it can.
        gateway: What the gateway reports about the way to the safety node; empty if nothing is wrong.
    """

    run_dir: Path
    waited_s: float
    answer: ArmAnswer | None = None
    trouble: str = ""
    gateway: str = ""


class StopRequest:
    """A request to disarm one run, repeated until it is answered."""

    def __init__(self, run_dir: Path, reason: str) -> None:
        self.run_dir, self._reason = run_dir, reason
        self._clock = SystemClock()
        self._asked = RequestIdentity.at(self._clock.now())
        self._began_s = time.monotonic()
        self._next_s = 0.0
        self._tell_s = self._began_s + BRAKE_WAIT_S
        self._answered: Received | None = None
        self._answered_s = 0.0
        self._braked = False
        self._gateway = ""
        self._bus = Bus(run_dir)
        try:
            self._bus.subscribe(STATE)
            self._bus.subscribe(SENT)
            self._bus.subscribe(GATEWAY_STATUS)
            self._bus.publisher(ARM)
        except BaseException:
            self._bus.close()
            raise

    def close(self) -> None:
        """Close the sockets."""
        self._bus.close()

    def step(self, wait_s: float) -> None:
        """Repeat the request if it is due, and wait for answers."""
        now_s = time.monotonic()
        if self._answered is None and now_s >= self._next_s:
            self._next_s = now_s + _REPEAT_S
            self._bus.publish(ARM, arm_message(self._asked, self._clock.now(), False, OPERATOR, self._reason))
        self._bus.wait(wait_s)
        for received in self._bus.receive():
            try:
                self._hear(received)
            except MessageError:
                continue  # invalid bytes must not end a request to stop the car

    def report(self) -> StopReport:
        """Report the answer once it is complete: with the brake, or 0.3 s after the safety node's answer without it."""
        waited_s = time.monotonic() - self._began_s
        if self._answered is None or not (self._braked or time.monotonic() - self._answered_s > BRAKE_WAIT_S):
            return StopReport(self.run_dir, waited_s, gateway=self._gateway)
        state = self._answered.message()
        answer = ArmAnswer(bool(state.granted), bool(state.armed), str(state.reason), self._braked)
        return StopReport(self.run_dir, waited_s, answer)

    def late(self) -> bool:
        """Whether it is time to tell the caller that there is no answer: after 0.3 s, then every second."""
        if self._answered is not None or time.monotonic() < self._tell_s:
            return False
        self._tell_s = time.monotonic() + _TELL_S
        return True

    def _hear(self, received: Received) -> None:
        if received.topic == STATE and self._answered is None:
            if received.message().answered_id == self._asked.ask_id:
                self._answered, self._answered_s = received, time.monotonic()
        elif received.topic == GATEWAY_STATUS:
            self._gateway = gateway_trouble(received)
        elif received.topic == SENT and self._answered is not None:
            since_ns = self._answered.info.publish_mono_ns
            self._braked |= received.info.publish_mono_ns >= since_ns and bool(received.message().braking)


def stop_runs(
    run_dirs: Sequence[Path],
    reason: str,
    tell: Callable[[StopReport], None],
    why_unreachable: Callable[[Path], str],
) -> None:
    """Disarm all runs at the same time, each until its safety node has answered or nothing can reach it any more.

    Args:
        tell: Called once for each run with its answer or its trouble, and before, with neither, while there is no answer.
        why_unreachable: Asked about a run that does not answer: why it never will; empty if it may.
    """
    requests: list[StopRequest] = []
    try:
        for run_dir in run_dirs:
            try:
                requests.append(StopRequest(run_dir, reason))
            except Exception as error:  # the other runs must still be stopped
                tell(StopReport(run_dir, 0.0, trouble=str(error) or type(error).__name__))
        waiting = list(requests)
        while waiting:
            for request in list(waiting):
                request.step(_REPEAT_S / len(waiting))
                report = request.report()
                if report.answer is None and not request.late():
                    continue
                if report.answer is None:
                    report = replace(report, trouble=why_unreachable(request.run_dir))
                if report.answer is not None or report.trouble:
                    waiting.remove(request)
                tell(report)
    finally:
        for request in requests:
            request.close()
