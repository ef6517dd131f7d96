"""When an attack may be shown: only while the safety node says, freshly, that the car is armed.

Armed means that the car is inside the fence, its poses are fresh, and everything else the safety node checks is well. So a
texture is never left on a monitor, and never drawn into images, while people carry the car about. Compositor and monitor obey.
"""

from __future__ import annotations

from typing import Any

from nodes.runtime.clock import NS_PER_S
from nodes.runtime.wire import MessageInfo

SAFETY_STATE = "/safety/state"


class Interlock:
    """Remembers what the safety node said last.

    Args:
        age_limit_s: Older than this it says nothing any more [s].
    """

    def __init__(self, age_limit_s: float = 0.5) -> None:
        self._age_limit_ns = round(age_limit_s * NS_PER_S)
        self._publish_ns: int | None = None
        self._armed, self._reason = False, ""

    def heard(self, message: Any, info: MessageInfo) -> None:
        """Note a ``SafetyState``."""
        self._armed, self._reason, self._publish_ns = bool(message.armed), str(message.reason), info.publish_mono_ns

    def refusal(self, mono_ns: int) -> str:
        """Why the attack may not be shown; empty if it may."""
        if self._publish_ns is None or mono_ns - self._publish_ns > self._age_limit_ns:
            return "interlock: no word of the safety node"
        return "" if self._armed else f"interlock: not armed: {self._reason}"
