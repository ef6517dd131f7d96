"""Independent checks of the arming: the held button, the clocks of other hosts, the fence.

Pure: time and messages come as arguments.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from nodes.control.stamps import AHEAD_LIMIT_S
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import ConfigError
from nodes.runtime.wire import MessageInfo

IDLE, HUMAN, AUTONOMY = "idle", "human", "autonomy"
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
            return "the button is not held"
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


def inside(point_m: Point, polygon_m: Sequence[Point]) -> bool:
    """Whether a point lies inside a simple polygon, convex or not (even-odd rule). False for points that are not finite."""
    x, y = point_m
    if not (math.isfinite(x) and math.isfinite(y)):
        return False
    result = False
    for (ax, ay), (bx, by) in _edges(polygon_m):
        if (ay > y) != (by > y) and x < ax + (y - ay) * (bx - ax) / (by - ay):
            result = not result
    return result


def edge_distance_m(point_m: Point, polygon_m: Sequence[Point]) -> float:
    """Distance from a point to the nearest edge of a polygon [m]."""
    return min(_segment_distance_m(point_m, a, b) for a, b in _edges(polygon_m))


def require_simple(polygon_m: Sequence[Point]) -> None:
    """Refuse a fence whose edges cross, because its inside is not well defined."""
    edges = _edges(polygon_m)
    for i, (a, b) in enumerate(edges):
        for j in range(i + 1, len(edges)):
            neighbours = j == i + 1 or (i == 0 and j == len(edges) - 1)
            if not neighbours and _cross(a, b, *edges[j]):
                raise ConfigError(
                    f"expected a fence whose edges do not cross, but edge {i + 1} ({a} to {b}) crosses edge {j + 1}"
                    f" ({edges[j][0]} to {edges[j][1]}); put the corners of fence_m in order"
                )


def _edges(polygon_m: Sequence[Point]) -> list[tuple[Point, Point]]:
    return list(zip(polygon_m, [*polygon_m[1:], polygon_m[0]], strict=True))


def _segment_distance_m(p: Point, a: Point, b: Point) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    length2 = dx * dx + dy * dy
    along = 0.0 if length2 == 0.0 else min(1.0, max(0.0, ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / length2))
    return math.hypot(p[0] - a[0] - along * dx, p[1] - a[1] - along * dy)


def _cross(a: Point, b: Point, c: Point, d: Point) -> bool:
    def side(p: Point, q: Point, r: Point) -> float:
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    return side(a, b, c) * side(a, b, d) < 0.0 and side(c, d, a) * side(c, d, b) < 0.0
