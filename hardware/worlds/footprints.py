"""Rectangles on the floor: the car's body, and its obstacles."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from advnerf_core.geometry import Rectangle

_REACHES_M = (0.02, 0.05, 0.1, 0.2)


@dataclass(frozen=True)
class Footprint(Rectangle):
    """An obstacle, or the car's body.

    Attributes:
        name: Name for reports.
    """

    name: str = ""

    def overlaps(self, other: Footprint) -> bool:
        """Whether two rectangles share area (separating axis theorem)."""
        dx, dy = other.x_m - self.x_m, other.y_m - self.y_m
        reach = math.hypot(self.half_length_m, self.half_width_m) + math.hypot(
            other.half_length_m, other.half_width_m
        )
        if dx * dx + dy * dy > reach * reach:
            return False
        c, s = math.cos(other.yaw_rad - self.yaw_rad), math.sin(other.yaw_rad - self.yaw_rad)
        for frame, one, two in ((self.yaw_rad, self, other), (other.yaw_rad, other, self)):
            cx, sx = math.cos(frame), math.sin(frame)
            along, across = abs(dx * cx + dy * sx), abs(dy * cx - dx * sx)
            if along >= one.half_length_m + two.half_length_m * abs(c) + two.half_width_m * abs(s):
                return False
            if across >= one.half_width_m + two.half_length_m * abs(s) + two.half_width_m * abs(c):
                return False
        return True

    def corners(self) -> list[tuple[float, float]]:
        """The four corners [m], counter-clockwise from the front left."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
        ends = [(a * self.half_length_m, b * self.half_width_m) for a, b in signs]
        return [(self.x_m + c * u - s * v, self.y_m + s * u + c * v) for u, v in ends]


def touched_by(body: Footprint, obstacles: Iterable[Footprint], half_m: float, edge: str) -> str:
    """Name of the obstacle that a body stands against: the nearest within 0.2 m, as a car stops just before it; empty if none is near.

    Args:
        half_m: The world ends at plus and minus this in x and y [m].
        edge: Name for the world's end, such as wall.
    """
    for reach_m in _REACHES_M:
        grown = replace(
            body, half_length_m=body.half_length_m + reach_m, half_width_m=body.half_width_m + reach_m
        )
        for obstacle in obstacles:
            if grown.overlaps(obstacle):
                return obstacle.name
        if any(max(abs(x), abs(y)) > half_m for x, y in grown.corners()):
            return edge
    return ""
