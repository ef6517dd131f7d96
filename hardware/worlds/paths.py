"""Reference paths as plain data: straight lines and circular arcs from a start pose, and poses along them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import cycle
from typing import Literal

from advnerf_core.plain import PlainData

Segment = tuple[Literal["line"], float] | tuple[Literal["arc"], float, float]
Pose = tuple[float, float, float]


@dataclass(frozen=True)
class ReferencePath(PlainData):
    """One drive: continuous in position and heading.

    `hardware.worlds.fitting.path_through` makes one from points.

    Attributes:
        start_pose: x [m], y [m], yaw [rad] of the path's start.
        segments: ``("line", length_m)`` or ``("arc", radius_m, angle_rad)`` in driving order, left positive.
        goal: Goal input of a goal-conditioned policy on this drive, such as a one-hot exit; empty without a goal.
        closed: Whether the end of the path is its start.
        drive_from: Start of the drives if it differs from the path's start, as on a closed path; x [m], y [m], yaw [rad].
    """

    start_pose: Pose
    segments: tuple[Segment, ...]
    goal: tuple[float, ...] = ()
    closed: bool = False
    drive_from: Pose | None = None

    def __post_init__(self) -> None:
        """Raise for an invalid path."""
        numbers = [
            *self.start_pose,
            *self.drive_start,
            *(value for segment in self.segments for value in segment[1:]),
        ]
        positive = [segment[1] for segment in self.segments]
        if (
            not len(self.start_pose) == len(self.drive_start) == 3
            or not self.segments
            or not all(map(math.isfinite, numbers))
            or min(positive) <= 0
        ):
            raise ValueError(
                "expected a finite start pose (x, y, yaw) and at least one line or arc of positive length or radius, got "
                f"{self.start_pose} and {self.segments}"
            )

    @property
    def drive_start(self) -> Pose:
        """x [m], y [m], yaw [rad] of the drives' start."""
        return self.start_pose if self.drive_from is None else self.drive_from

    @property
    def length_m(self) -> float:
        """Length of the whole path [m]."""
        return sum(segment_length_m(segment) for segment in self.segments)

    def pose_at(self, s_m: float) -> Pose:
        """Point and heading (x [m], y [m], yaw [rad]) at a distance along the path.

        A closed path wraps around; an open one is extended straight beyond its ends.
        """
        x, y, yaw = self.start_pose
        left = s_m % self.length_m if self.closed else s_m
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

    def stretch(self, from_m: float, length_m: float) -> ReferencePath:
        """A part of this path as an open one; that of a closed path may pass its start.

        Raises:
            ValueError: An open path ends within it, or the length is not positive.
        """
        if length_m <= 0.0 or from_m < 0.0 or (not self.closed and from_m + length_m > self.length_m):
            raise ValueError(
                f"expected a stretch of a path of {self.length_m:.2f} m, got {length_m:g} m from {from_m:g} m"
            )
        pieces: list[Segment] = []
        at_m = -(from_m % self.length_m if self.closed else from_m)
        for segment in cycle(self.segments):
            piece_m = segment_length_m(segment)
            begin_m, end_m = max(at_m, 0.0), min(at_m + piece_m, length_m)
            if end_m > begin_m:
                share_m = end_m - begin_m
                angle_rad = 0.0 if segment[0] == "line" else math.copysign(share_m / segment[1], segment[2])
                pieces.append(("line", share_m) if segment[0] == "line" else ("arc", segment[1], angle_rad))
            at_m += piece_m
            if at_m >= length_m:
                break
        return ReferencePath(self.pose_at(from_m), tuple(pieces), self.goal)

    def mirrored(self, across: Literal["x", "y"]) -> ReferencePath:
        """The same drive mirrored at the x or the y axis of the world: left and right of the axis are swapped."""

        def turned_over(pose: Pose) -> Pose:
            x, y, yaw = pose
            return (x, -y, -yaw) if across == "x" else (-x, y, math.pi - yaw)

        turned: tuple[Segment, ...] = tuple(
            piece if piece[0] == "line" else (piece[0], piece[1], -piece[2]) for piece in self.segments
        )
        begin = None if self.drive_from is None else turned_over(self.drive_from)
        return ReferencePath(turned_over(self.start_pose), turned, self.goal, self.closed, begin)


def segment_length_m(segment: Segment) -> float:
    """Length of one piece of a path [m]."""
    return segment[1] if segment[0] == "line" else segment[1] * abs(segment[2])
