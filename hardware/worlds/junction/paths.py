"""The three drives through the junction, as plain lines and arcs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Segment = tuple[Literal["line"], float] | tuple[Literal["arc"], float, float]
PathName = Literal["straight", "right", "left"]
ExitName = Literal["east", "south", "west"]

# The order of the one-hot goal that a goal-conditioned policy is given.
EXITS: tuple[ExitName, ...] = ("east", "south", "west")


@dataclass(frozen=True)
class ReferencePath:
    """One drive: continuous in position and heading, open at both ends.

    Attributes:
        name: What the car does at the junction.
        exit: Road by which it leaves.
        start_pose: x [m], y [m], yaw [rad] where the drive starts.
        segments: In driving order, ``("line", length_m)`` or ``("arc", radius_m, angle_rad)``, left positive.
    """

    name: PathName
    exit: ExitName
    start_pose: tuple[float, float, float]
    segments: tuple[Segment, ...]

    @property
    def goal(self) -> tuple[float, ...]:
        """The exit as one-hot code in the order of ``EXITS``."""
        return tuple(1.0 if name == self.exit else 0.0 for name in EXITS)

    @property
    def length_m(self) -> float:
        """Length of the whole path [m]."""
        return sum(segment_length_m(segment) for segment in self.segments)

    def pose_at(self, s_m: float) -> tuple[float, float, float]:
        """Point and heading (x [m], y [m], yaw [rad]) at a distance along the path, which is extended straight beyond its ends."""
        x, y, yaw = self.start_pose
        left = s_m
        for index, segment in enumerate(self.segments):
            last = index == len(self.segments) - 1
            length = segment_length_m(segment)
            along = left if last else min(left, length)
            if segment[0] == "arc" and along > 0.0:
                inside = min(along, length)
                turn = math.copysign(inside / segment[1], segment[2])
                chord = 2.0 * segment[1] * math.sin(0.5 * abs(turn))
                x, y = x + chord * math.cos(yaw + 0.5 * turn), y + chord * math.sin(yaw + 0.5 * turn)
                yaw, along, left = yaw + turn, along - inside, left - inside
            x, y, left = x + along * math.cos(yaw), y + along * math.sin(yaw), left - along
            if left <= 0.0:
                break
        return x, y, math.remainder(yaw, 2.0 * math.pi)

    def mirrored(self, across: Literal["x", "y"]) -> ReferencePath:
        """The same drive seen in a mirror along the x or the y axis of the world: what was on the left of the axis is on its right."""
        x, y, yaw = self.start_pose
        start = (x, -y, -yaw) if across == "x" else (-x, y, math.pi - yaw)
        turned: tuple[Segment, ...] = tuple(
            piece if piece[0] == "line" else (piece[0], piece[1], -piece[2]) for piece in self.segments
        )
        return ReferencePath(self.name, self.exit, start, turned)


def segment_length_m(segment: Segment) -> float:
    """Length of one piece of a path [m]."""
    return segment[1] if segment[0] == "line" else segment[1] * abs(segment[2])


def junction_paths(
    lane_m: float, right_radius_m: float, left_radius_m: float, approach_m: float, beyond_m: float
) -> dict[PathName, ReferencePath]:
    """The drives straight on, right and left along the middle of the right-hand lanes.

    Straight and right start in the west arm and leave to the east and to the south; left starts in the south arm and leaves
    to the west.

    Args:
        lane_m: Width of a lane [m]; every road has two.
        right_radius_m: Radius of the right turn [m].
        left_radius_m: Radius of the left turn [m].
        approach_m: Distance of the start poses from the middle of the junction, along their road [m].
        beyond_m: Length of the last line of the drives that turn; the straight drive is as long as the longer of them [m].
    """
    middle, quarter = 0.5 * lane_m, 0.5 * math.pi
    right: tuple[Segment, ...] = (
        ("line", approach_m - middle - right_radius_m), ("arc", right_radius_m, -quarter), ("line", beyond_m),
    )  # fmt: skip
    left: tuple[Segment, ...] = (
        ("line", approach_m + middle - left_radius_m), ("arc", left_radius_m, quarter), ("line", beyond_m),
    )  # fmt: skip
    west, south = (-approach_m, -middle, 0.0), (middle, -approach_m, quarter)
    longest = max(sum(map(segment_length_m, segments)) for segments in (right, left))
    return {
        "straight": ReferencePath("straight", "east", west, (("line", longest),)),
        "right": ReferencePath("right", "south", west, right),
        "left": ReferencePath("left", "west", south, left),
    }
