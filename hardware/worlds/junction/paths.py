"""The three drives through the junction, as plain lines and arcs."""

from __future__ import annotations

import math
from typing import Literal

from hardware.worlds.paths import ReferencePath, Segment, segment_length_m

PathName = Literal["straight", "right", "left"]
ExitName = Literal["east", "south", "west"]

# The order of the one-hot goal that a goal-conditioned policy is given.
EXITS: tuple[ExitName, ...] = ("east", "south", "west")
EXIT_OF: dict[PathName, ExitName] = {"straight": "east", "right": "south", "left": "west"}


def goal_of(name: PathName) -> tuple[float, ...]:
    """The exit of a drive as one-hot code in the order of ``EXITS``."""
    return tuple(1.0 if exit_name == EXIT_OF[name] else 0.0 for exit_name in EXITS)


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
        ("line", approach_m - middle - right_radius_m),
        ("arc", right_radius_m, -quarter),
        ("line", beyond_m),
    )
    left: tuple[Segment, ...] = (
        ("line", approach_m + middle - left_radius_m),
        ("arc", left_radius_m, quarter),
        ("line", beyond_m),
    )
    west, south = (-approach_m, -middle, 0.0), (middle, -approach_m, quarter)
    longest = max(sum(map(segment_length_m, segments)) for segments in (right, left))
    return {
        "straight": ReferencePath(west, (("line", longest),), goal_of("straight")),
        "right": ReferencePath(west, right, goal_of("right")),
        "left": ReferencePath(south, left, goal_of("left")),
    }
