"""The rule for roads whose turns a car can miss, on paths of which lengths and turns are known."""

import math

import pytest

from benchmarks.turning_roads import missable_turn_m
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
