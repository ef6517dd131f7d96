"""Independent checks of the arming: the held button, the clocks of other hosts, the fence.

Pure: time and messages come as arguments.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from nodes.control.stamps import AHEAD_LIMIT_S
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.wire import MessageInfo

IDLE, HUMAN, AUTONOMY = "idle", "human", "autonomy"
NOT_HELD = "the button is not held"
Point = tuple[float, float]
_MOST_DOUBT_S = 3600.0
# Error of a driver that converts a device's clock to real time [s].
_ONE_HOST_S = 0.005


@dataclass
class HandGate:
    """Hold to run: the operator must hold a button, and the teleop node must keep reporting it.

    Attributes:
        required: Whether the car may only move while the button is held.
        age_limit_s: Time without a message of the teleop node after which the button counts as released [s].
        mode: Function of the button: ``human`` (the operator drives), ``autonomy`` (the software drives) or ``idle``.
        pressed_stop: Whether the e-stop is pressed, or was pressed since the last arming.
    """

    required: bool = False
    age_limit_s: float = 0.2
    mode: str = IDLE
    pressed_stop: bool = False
    _since_ns: int | None = None
    _instance_id: int | None = None
    _refused: str = ""

    def refuse(self, why: str) -> None:
        """Note that a message did not count. The button's state is unchanged, so that the next message is not a new press."""
        self._refused = why

    def heard(self, mode: str, pressed_stop: bool, info: MessageInfo, since_ns: int | None = None) -> bool:
        """Note a message. Returns whether the button was just pressed.

        After a restart of the teleop node, the button must be seen released before a press counts.

        Args:
            mode: Function of the button.
            pressed_stop: Whether the e-stop is pressed.
            info: Transport data of the message.
            since_ns: Time of the report on this host's monotonic clock, if it is earlier than its publication [ns].
        """
        known = info.instance_id == self._instance_id
        began = known and self.mode == IDLE and mode in (HUMAN, AUTONOMY)
        if not known and mode != IDLE:
            mode = f"{mode} since before the teleop node was heard"
        elif known and self.mode not in (IDLE, HUMAN, AUTONOMY) and mode != IDLE:
            mode = self.mode  # still the earlier press
        self.mode, self.pressed_stop = mode, pressed_stop
        since_ns = info.publish_mono_ns if since_ns is None else since_ns
        self._since_ns, self._instance_id = min(since_ns, info.fresh_mono_ns), info.instance_id
        self._refused = ""
        return began

    def problem(self, mono_ns: int) -> str:
        """Return why the car may not move; empty if it may."""
        if self.pressed_stop:
            return "the e-stop is pressed"
        if not self.required:
            return ""
        if self._since_ns is None:
            return self._refused or "no message from the teleop node yet; start it: advnerf car teleop"
        if (age_s := (mono_ns - self._since_ns) / NS_PER_S) > self.age_limit_s:
            return self._refused or f"no message from the teleop node for {age_s:.2f} s"
        if self.mode == IDLE:
            return NOT_HELD
        return (
            "" if self.mode in (HUMAN, AUTONOMY) else f"the button is held as {self.mode}; release it first"
        )

    @property
    def drives(self) -> bool:
        """Whether the operator drives, which overrides all other drivers."""
        return self.required and self.mode == HUMAN


@dataclass
class ClockGate:
    """Check of the clocks of other hosts. A wrong clock makes every age computed from a capture stamp wrong.

    Attributes:
        offset_limit_s: Largest accepted offset between this host's clock and another's [s].
        error_limit_s: Largest accepted error bound of an offset [s].
        peers: Hosts whose offset must be known. Other hosts are checked once they have been measured.
        age_limit_s: Largest accepted age of a measurement [s].
    """

    offset_limit_s: float = 0.03
    error_limit_s: float = 0.1
    peers: tuple[str, ...] = ()
    age_limit_s: float = 3.0
    _heard: dict[str, tuple[float, float, int]] = field(default_factory=dict)

    def heard(self, peer: str, offset_s: float, error_s: float, info: MessageInfo) -> None:
        """Note a measurement."""
        self._heard[peer] = (offset_s, error_s, info.fresh_mono_ns)

    def doubt_ns(self, mono_ns: int) -> int:
        """Largest error of a time from another host, by the newest measurements [ns]; 0 without other hosts."""
        worst_s = 0.0
        for offset_s, error_s, publish_ns in self._heard.values():
            if (mono_ns - publish_ns) / NS_PER_S <= self.age_limit_s:
                doubt_s = abs(offset_s) + error_s
                # Not finite, or too large: the age of a request cannot be known.
                worst_s = max(worst_s, doubt_s) if doubt_s <= _MOST_DOUBT_S else _MOST_DOUBT_S
        return round(worst_s * NS_PER_S)

    def ahead_s(self, mono_ns: int) -> float:
        """Largest accepted lead of a capture stamp over this host's clock [s]: the error of the clocks, within a fixed limit."""
        return min(_ONE_HOST_S + self.doubt_ns(mono_ns) / NS_PER_S, AHEAD_LIMIT_S)

    def problem(self, mono_ns: int) -> str:
        """Return why the car may not move; empty if it may."""
        for peer in self.peers:
            if peer not in self._heard:
                return f"the clock offset to {peer} is not known yet"
        for peer, (offset_s, error_s, publish_ns) in self._heard.items():
            age_s = (mono_ns - publish_ns) / NS_PER_S
            if age_s > self.age_limit_s:
                if peer in self.peers:
                    return f"the clock offset to {peer} was last measured {age_s:.1f} s ago"
                continue  # a host that is gone and is not required
            if not abs(offset_s) <= self.offset_limit_s:
                return (
                    f"the clock of {peer} is off by {1e3 * offset_s:.0f} ms, the limit is {1e3 * self.offset_limit_s:.0f} ms;"
                    " synchronise both hosts (chrony)"
                )
            if not error_s <= self.error_limit_s:
                return f"the clock offset to {peer} is only known to {1e3 * error_s:.0f} ms; the link is too slow"
        return ""
