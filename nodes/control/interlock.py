"""The interlock of attacks: an attack is shown only while a fresh message of the safety node says that the car is armed.

Armed means that the car is inside the fence, its poses are fresh, and all other checks of the safety node pass. So a texture is
neither left on a monitor nor drawn into images while people carry the car. The compositor and the monitor node use the interlock.
"""

from __future__ import annotations

from typing import Any

from nodes.control.stamps import REQUEST_AGE_S, stamp_age_s, stamp_problem
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.messages import stamp_ns
from nodes.runtime.wire import MessageInfo

SAFETY_STATE, ATTACK_SWITCH = "/safety/state", "/attack/switch"


# Largest age of a message of the safety node.
_AGE_LIMIT_NS = NS_PER_S // 2
_SWITCHED_OFF = "switched off by "


class Interlock:
    """Remembers the last message of the safety node."""

    def __init__(self) -> None:
        self._publish_ns: int | None = None
        self._armed, self._reason = False, ""

    def heard(self, message: Any, info: MessageInfo) -> None:
        """Note a ``SafetyState``."""
        self._armed, self._reason, self._publish_ns = (
            bool(message.armed),
            str(message.reason),
            info.fresh_mono_ns,
        )

    def refusal(self, mono_ns: int) -> str:
        """Return why the attack may not be shown; empty if it may."""
        if self._publish_ns is None or mono_ns - self._publish_ns > _AGE_LIMIT_NS:
            return "interlock: no message from the safety node"
        return "" if self._armed else f"interlock: not armed: {self._reason}"


class AttackSwitch:
    """Remembers whether the operator wants the attack to be shown. It is shown until a message says otherwise."""

    def __init__(self) -> None:
        self._off_by = ""

    def heard(self, message: Any, real_ns: int) -> None:
        """Note an ``AttackSwitch`` message. To show the attack, it must be of a moment ago on this host's clock [ns]."""
        if message.show and stamp_problem(stamp_age_s(stamp_ns(message), real_ns), REQUEST_AGE_S):
            return
        self._off_by = "" if message.show else str(message.source) or "the operator"

    def refusal(self) -> str:
        """Return why the attack may not be shown; empty if it may."""
        return f"{_SWITCHED_OFF}{self._off_by}" if self._off_by else ""


def switched_off_by(reason: str) -> str:
    """Who switched the attack off, by the reason of a label (see `AttackSwitch.refusal`); empty if nobody did."""
    return reason.removeprefix(_SWITCHED_OFF) if reason.startswith(_SWITCHED_OFF) else ""
