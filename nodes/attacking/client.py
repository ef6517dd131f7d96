"""What a person asks of a running attack node."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from nodes.attacking.request import AttackRequest, request_text
from nodes.runtime.bus import Bus
from nodes.runtime.errors import LaunchError
from nodes.runtime.messages import header, types

_LISTENING_S = 5.0
_SILENCE_S = 10.0
ENDED = ("done", "failed", "cancelled", "refused")


def new_request_id(name: str) -> str:
    """A name for a request that is not taken: its own, shortened, and the time."""
    safe = "".join(letter if (letter.isalnum() and letter.isascii()) or letter in "-_" else "-" for letter in name)
    return f"{safe.strip('-_')[:24] or 'attack'}-{time.strftime('%Y%m%d-%H%M%S')}"


def ask_for_attack(
    run_dir: Path, request: AttackRequest, request_id: str, tell: Callable[[Any], None], follow: bool = True
) -> Any:
    """Send a request and listen until it has ended, or only until the node has answered.

    Args:
        run_dir: Run folder of the node.
        request: What is asked for.
        request_id: Its name; the very same request under the same name goes on where it was.
        tell: Called with every ``AttackProgress`` of it.
        follow: Wait for the end.

    Returns:
        The last ``AttackProgress``.

    Raises:
        LaunchError: No node listens, or it has fallen silent.
    """
    message = types.AttackRequest(
        header=header(time.time_ns()), request_id=request_id, request=request_text(request), source="operator"
    )
    with Bus(run_dir) as bus:
        _send(bus, "/attack/request", message)
        for progress in _progress(bus, request_id):
            tell(progress)
            if not follow or progress.state in ENDED:
                return progress
    raise AssertionError("unreachable: the progress ends with an error")


def cancel_attack(run_dir: Path, request_id: str, reason: str) -> Any:
    """End the search of a request, or whichever there is; returns the node's ``AttackProgress`` after it."""
    message = types.AttackCancel(header=header(time.time_ns()), request_id=request_id, reason=reason)
    with Bus(run_dir) as bus:
        _send(bus, "/attack/cancel", message)
        for progress in _progress(bus, request_id or None):
            return progress
    raise AssertionError("unreachable: the progress ends with an error")


def _send(bus: Bus, topic: str, message: Any) -> None:
    bus.publisher(topic)
    bus.subscribe("/attack/progress")
    bus.wait_for_subscribers([topic], _LISTENING_S)
    bus.wait(0.0)
    bus.receive()  # what was said before is no answer
    bus.publish(topic, message)


def _progress(bus: Bus, request_id: str | None) -> Iterator[Any]:
    asked_ns, heard_s = time.monotonic_ns(), time.monotonic()
    while time.monotonic() - heard_s < _SILENCE_S:
        bus.wait(0.1)
        for received in bus.receive():
            heard_s = time.monotonic()
            message = received.message()
            if received.info.publish_mono_ns >= asked_ns and request_id in (None, message.request_id):
                yield message
    raise LaunchError(f"the attack node has said nothing of this request for {_SILENCE_S:g} s; look into its log")
