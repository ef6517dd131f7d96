"""Requests to a player of a bag, and its answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nodes.runtime.asking import NoAnswerError, ask
from nodes.runtime.bus import Bus, Received
from nodes.runtime.clock import Now
from nodes.runtime.errors import LaunchError
from nodes.runtime.messages import header, types
from nodes.runtime.requests import RequestIdentity

_CONTROL, _STATE = "/player/control", "/player/state"
_REPEAT_S, _PATIENCE_S = 0.05, 3.0


def ask_player(run_dir: Path, command: str) -> tuple[bool, str]:
    """Send a command to a player: pause, resume, step, change the speed, or stop. Returns whether it succeeded, and the answer.

    Raises:
        LaunchError: No player answered.
    """

    def make(asked: RequestIdentity, now: Now) -> Any:
        return types.PlayerControl(header=header(asked.real_ns), command=command, ask_id=asked.ask_id)

    def read(ask_id: str, received: Received) -> tuple[bool, str] | None:
        state = received.message()
        return (bool(state.granted), str(state.answer)) if state.answered_id == ask_id else None

    with Bus(run_dir) as bus:
        try:
            return ask(bus, _CONTROL, make, _STATE, read, every_s=_REPEAT_S, patience_s=_PATIENCE_S)
        except NoAnswerError:
            raise LaunchError(
                f"expected an answer from a player within {_PATIENCE_S:g} s, got none; is one running with the same --folder ({run_dir})?"
            ) from None
