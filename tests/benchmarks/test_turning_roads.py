"""The rule for roads whose turns a car can miss, on paths of which lengths and turns are known."""

import math

import pytest

from benchmarks.turning_roads import approached_turns_m, missable_turn_m
from hardware.worlds.paths import ReferencePath, Segment

HALF_LANE_M = 1.75
RIGHT_ANGLE = 0.5 * math.pi


def turn_of(*segments: Segment) -> float | None:
    return missable_turn_m(ReferencePath((0.0, 0.0, 0.0), segments), HALF_LANE_M, 12.0)


def test_a_sharp_turn_to_the_right_begins_where_its_arcs_do() -> None:
    assert turn_of(("line", 50.0), ("arc", 10.0, -RIGHT_ANGLE), ("line", 30.0)) == 50.0
    halves: tuple[Segment, ...] = (("arc", 10.0, -0.6), ("arc", 12.0, -0.6))
    assert turn_of(("line", 50.0), *halves, ("line", 30.0)) == 50.0
    gentle: Segment = ("arc", 40.0, -1.0)
    assert turn_of(("line", 20.0), gentle, *halves, ("line", 30.0)) == pytest.approx(60.0)


def test_what_cannot_be_missed_is_none() -> None:
    assert turn_of(("line", 100.0)) is None
    assert turn_of(("line", 50.0), ("arc", 40.0, -RIGHT_ANGLE), ("line", 30.0)) is None  # gentle
    assert turn_of(("line", 50.0), ("arc", 10.0, 0.6), ("arc", 10.0, -0.6), ("line", 30.0)) is None  # a bend
    assert turn_of(("line", 50.0), ("arc", 10.0, -RIGHT_ANGLE), ("line", 11.0)) is None  # no way behind it


def test_a_road_that_turns_left_first_is_not_taken() -> None:
    right: Segment = ("arc", 10.0, -RIGHT_ANGLE)
    assert turn_of(("line", 50.0), ("arc", 20.5, RIGHT_ANGLE), ("line", 50.0), right, ("line", 30.0)) is None


def test_drives_of_a_closed_route_begin_before_the_turns_that_have_a_way_before_them() -> None:
    """A square with one corner cut off: the turn after the short side has too little way before it, and the first one's is across the seam."""
    corner: Segment = ("arc", 0.2, -RIGHT_ANGLE)
    sides: list[Segment] = [("line", 1.0), ("line", 0.3), ("line", 2.0), ("line", 0.4)]
    square = ReferencePath(
        (0.0, 0.0, 0.0), tuple(piece for side in sides for piece in (corner, side)), closed=True
    )
    arc_m = 0.2 * RIGHT_ANGLE
    # Ways before the four corners: 0.4, 1.0, 0.3 and 2.0.
    assert approached_turns_m(square, 0.1, 0.4) == pytest.approx(
        [square.length_m - 0.4, arc_m + 0.6, 3.0 * arc_m + 2.9]
    )
    assert approached_turns_m(square, 0.1, 1.5) == pytest.approx([3.0 * arc_m + 1.8])
    assert approached_turns_m(square, 0.01, 0.4) == []  # gentle
