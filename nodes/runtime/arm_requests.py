"""Requests to arm and to disarm: their messages, and how a command asks to arm and waits for the answer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nodes.runtime.asking import NoAnswerError, ask
from nodes.runtime.bus import Bus, Received
from nodes.runtime.clock import Now
from nodes.runtime.errors import LaunchError
from nodes.runtime.messages import header, types
from nodes.runtime.node import FAULT, READY
from nodes.runtime.requests import RequestIdentity
from nodes.runtime.topics import status_topic

ARM, STATE, SENT = "/arm", "/safety/state", "/motor/sent"
OPERATOR = "operator"
GATEWAY_STATUS = status_topic("gateway")
_REPEAT_S = 0.02
_ARM_PATIENCE_S = 2.0
BRAKE_WAIT_S = 0.3


@dataclass(frozen=True)
class ArmAnswer:
    """The answer to a request.

    Attributes:
        armed: Whether the car is armed after the request.
        text: Why the car is not armed, or who armed it.
        braked: Whether the motor node has reported since then that it brakes. Only set by a request to disarm.
    """

    granted: bool
    armed: bool
    text: str
    braked: bool = False


def arm_message(asked: RequestIdentity, now: Now, arm: bool, source: str, reason: str) -> Any:
    """Make the message for one repeat of a request to arm or to disarm."""
    return types.Arm(
        header=header(asked.real_ns),
        arm=arm,
        source=source,
        reason=reason,
        ask_id=asked.ask_id,
        age_ns=asked.age_ns(now),
    )


def gateway_trouble(status: Received) -> str:
    """Say what a status of the gateway reports about the way to a safety node on another host; empty if nothing is wrong."""
    message = status.message()
    # A gateway that is only ready does not hear the other host, which matters where it brings the safety node's word from there.
    unheard = message.state == READY and STATE in message.publications
    return f"The gateway reports: {message.text}" if unheard or message.state == FAULT else ""


def ask_to_arm(run_dir: Path, reason: str) -> ArmAnswer:
    """Ask the safety node to arm, as the operator.

    Raises:
        LaunchError: The safety node did not answer. On a host without one, it says what the gateway reports about the way there.
    """
    trouble = ""

    def make(asked: RequestIdentity, now: Now) -> Any:
        return arm_message(asked, now, True, OPERATOR, reason)

    def read(ask_id: str, received: Received) -> Received | None:
        nonlocal trouble
        if received.topic == GATEWAY_STATUS:
            trouble = gateway_trouble(received)
        return received if received.topic == STATE and received.message().answered_id == ask_id else None

    with Bus(run_dir) as bus:
        bus.subscribe(GATEWAY_STATUS)
        try:
            answered = ask(bus, ARM, make, STATE, read, every_s=_REPEAT_S, patience_s=_ARM_PATIENCE_S)
        except NoAnswerError:
            advice = (
                f"{trouble}. To be safe, run advnerf disarm on the car"
                if trouble
                else "Check that the node is running. To be safe, run advnerf disarm"
            )
            raise LaunchError(
                f"expected an answer from the safety node within {_ARM_PATIENCE_S:g} s, got none; the car may be armed. "
                f"{advice}"
            ) from None
    state = answered.message()
    text = str(state.source if state.armed else state.reason) if state.granted else str(state.answer)
    return ArmAnswer(bool(state.granted), bool(state.armed), text)
