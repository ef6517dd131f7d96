"""Requests of a user to a running attack node."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from nodes.runtime.asking import NoAnswerError, ask
from nodes.runtime.bus import Bus, Received
from nodes.runtime.clock import Now
from nodes.runtime.errors import LaunchError
from nodes.runtime.messages import header, types
from nodes.runtime.requests import RequestIdentity

_REPEAT_S, _ANSWER_S = 0.2, 10.0
_SILENCE_S = 10.0
ENDED = ("done", "failed", "cancelled", "refused")


def new_request_id(name: str) -> str:
    """A free name for a request: its own, shortened, and the time."""
    safe = "".join(
        letter if (letter.isalnum() and letter.isascii()) or letter in "-_" else "-" for letter in name
    )
    return f"{safe.strip('-_')[:24] or 'attack'}-{time.strftime('%Y%m%d-%H%M%S')}"


def ask_for_attack(
    run_dir: Path, request: str, request_id: str, tell: Callable[[Any], None], follow: bool = True
) -> Any:
    """Send a request, as `request.as_text` writes it, and listen until it has ended, or only until the node has answered.

    Args:
        request_id: Name of the request; an identical request under the same name is resumed.
        tell: Called with every ``AttackProgress`` of the request.

    Returns:
        The last ``AttackProgress``.

    Raises:
        LaunchError: No node listens, or it has fallen silent.
    """

    def make(asked: RequestIdentity, now: Now) -> Any:
        return types.AttackRequest(
            header=header(asked.real_ns),
            request_id=request_id,
            request=request,
            source="operator",
            ask_id=asked.ask_id,
        )

    with Bus(run_dir) as bus:
        progress = _ask(bus, "/attack/request", make)
        tell(progress)
        if not follow or progress.state in ENDED:
            return progress
        for progress in _progress(bus, request_id):
            tell(progress)
            if progress.state in ENDED:
                return progress
    raise AssertionError("unreachable: the progress ends with an error")


def cancel_attack(run_dir: Path, request_id: str, reason: str) -> Any:
    """End the search of a request, or the running one; returns the node's ``AttackProgress`` after it."""

    def make(asked: RequestIdentity, now: Now) -> Any:
        return types.AttackCancel(
            header=header(asked.real_ns), request_id=request_id, reason=reason, ask_id=asked.ask_id
        )

    with Bus(run_dir) as bus:
        return _ask(bus, "/attack/cancel", make)


def _ask(bus: Bus, topic: str, make: Callable[[RequestIdentity, Now], Any]) -> Any:
    """Send a message until the attack node has answered it; returns the progress with the answer."""

    def read(ask_id: str, received: Received) -> Any:
        progress = received.message()
        return progress if progress.answered_id == ask_id else None

    try:
        return ask(bus, topic, make, "/attack/progress", read, every_s=_REPEAT_S, patience_s=_ANSWER_S)
    except NoAnswerError:
        raise LaunchError(
            f"the attack node did not answer within {_ANSWER_S:g} s; is it running with the same --folder?"
        ) from None


def _progress(bus: Bus, request_id: str) -> Iterator[Any]:
    heard_s = time.monotonic()
    while time.monotonic() - heard_s < _SILENCE_S:
        bus.wait(0.1)
        for received in bus.receive():
            heard_s = time.monotonic()
            message = received.message()
            if message.request_id == request_id:
                yield message
    raise LaunchError(
        f"the attack node has said nothing of this request for {_SILENCE_S:g} s; look into its log"
    )
