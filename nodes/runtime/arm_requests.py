"""Requests to arm and to disarm: their messages, and how a command sends one and waits for the answer."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nodes.runtime.asking import NoAnswerError, ask
from nodes.runtime.bus import Bus, Received
from nodes.runtime.clock import Now
from nodes.runtime.errors import LaunchError
from nodes.runtime.messages import header, types
from nodes.runtime.requests import Asked

ARM, STATE, SENT = "/arm", "/safety/state", "/motor/sent"
OPERATOR = "operator"
_REPEAT_S = 0.02
_ARM_PATIENCE_S = 2.0
BRAKE_WAIT_S = 0.3


@dataclass(frozen=True)
class ArmAnswer:
    """The answer to a request.

    Attributes:
        granted: Whether the safety node granted it.
        armed: Whether the car is armed after the request.
        text: Why the car is not armed, or who armed it.
        braked: Whether the motor node has reported since then that it brakes. Only set by a request to disarm.
    """

    granted: bool
    armed: bool
    text: str
    braked: bool = False


def arm_message(asked: Asked, now: Now, arm: bool, source: str, reason: str) -> Any:
    """Make the message for one repeat of a request to arm or to disarm."""
    return types.Arm(
        header=header(asked.real_ns),
        arm=arm,
        source=source,
        reason=reason,
        ask_id=asked.ask_id,
        age_ns=asked.age_ns(now),
    )


def ask_to_arm(run_dir: Path, reason: str) -> ArmAnswer:
    """Ask the safety node to arm, as the operator.

    Raises:
        LaunchError: The safety node did not answer.
    """
    with Bus(run_dir) as bus:
        try:
            answered = _ask(bus, True, reason, _ARM_PATIENCE_S, lambda waited_s: None)
        except NoAnswerError:
            raise LaunchError(
                f"expected an answer from the safety node within {_ARM_PATIENCE_S:g} s, got none; the car may be armed."
                " Check that the node is running. To be safe, run advnerf disarm"
            ) from None
    state = answered.message()
    text = str(state.source if state.armed else state.reason) if state.granted else str(state.answer)
    return ArmAnswer(bool(state.granted), bool(state.armed), text)


def ask_to_disarm(run_dir: Path, reason: str, silent: Callable[[float], None]) -> ArmAnswer:
    """Ask the safety node to disarm, as the operator, until it answers. Then check that the motor node brakes.

    Args:
        run_dir: Folder of the run.
        reason: Reason to record.
        silent: Called with the time waited so far [s] while the safety node does not answer.
    """
    with Bus(run_dir) as bus:
        bus.subscribe(SENT)
        answered = _ask(bus, False, reason, None, silent)
        braked = _wait_for_brake(bus, answered.info.publish_mono_ns)
    state = answered.message()
    return ArmAnswer(bool(state.granted), bool(state.armed), str(state.reason), braked)


def _ask(
    bus: Bus, wanted: bool, reason: str, patience_s: float | None, silent: Callable[[float], None]
) -> Received:
    def make(asked: Asked, now: Now) -> Any:
        return arm_message(asked, now, wanted, OPERATOR, reason)

    def read(ask_id: str, received: Received) -> Received | None:
        return received if received.topic == STATE and received.message().answered_id == ask_id else None

    return ask(
        bus,
        ARM,
        make,
        STATE,
        read,
        every_s=_REPEAT_S,
        patience_s=patience_s,
        silent=silent,
        silent_after_s=BRAKE_WAIT_S,
    )


def _wait_for_brake(bus: Bus, since_mono_ns: int) -> bool:
    """Whether the motor node reports within a moment that it brakes."""
    deadline = time.monotonic() + BRAKE_WAIT_S
    while (left_s := deadline - time.monotonic()) > 0.0:
        bus.wait(left_s)
        for received in bus.receive():
            if (
                received.topic == SENT
                and received.info.publish_mono_ns >= since_mono_ns
                and received.message().braking
            ):
                return True
    return False
