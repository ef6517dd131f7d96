"""What a world says about itself: as plain data, and refused where it cannot be."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from advnerf_core.geometry import Pinhole, camera_mount
from hardware.worlds.paths import ReferencePath
from hardware.worlds.world import (
    Box,
    CarDescription,
    Traits,
    WorldDescription,
    WorldError,
    members_of_a_world,
)

PATH = ReferencePath((0.0, 0.0, 0.0), (("line", 10.0),), (1.0, 0.0))
CAR = CarDescription("ackermann", 1.2, (-0.4, 0.5), 0.5)


def description(**changes: Any) -> WorldDescription:
    values: dict[str, Any] = {
        "paths": {"ahead": PATH, "back": replace(PATH, start_pose=(9.0, 2.0, 3.0), goal=(0.0, 1.0))},
        "off_track_m": 0.6,
        "car": CAR,
        "camera": Pinhole(64, 48, 40.0, 40.0, 32.0, 24.0),
        "T_car_from_camera": camera_mount(0.3, 0.0, 0.5, 0.1),
        "box": Box((-1.0, -2.0, 0.0), (11.0, 2.0, 3.0)),
        "road_edge": (np.array([(0.0, 1.0), (10.0, 1.0)]),),
        "facts": {"junction_id": 7},
    }
    return WorldDescription(**{**values, **changes})


def test_plain_data_brings_the_same_description_back() -> None:
    for each in (
        description(),
        description(car=CarDescription("dubins", 6.0, (-1.2, 1.2)), lanes=(PATH,), road_edge=()),
    ):
        again = WorldDescription.from_dict(json.loads(json.dumps(each.to_dict())))
        assert again.to_dict() == each.to_dict()
        assert list(again.paths) == ["ahead", "back"]  # their order is that of the world
        np.testing.assert_array_equal(again.T_car_from_camera, each.T_car_from_camera)
    assert again.car.wheelbase_m is None


def test_lanes_are_the_paths_where_none_are_given() -> None:
    assert description().lanes == tuple(description().paths.values())
    assert description(lanes=(PATH,)).lanes == (PATH,)


def test_units_and_the_larger_side_of_a_car() -> None:
    assert (CAR.largest_control, CAR.control_unit) == (0.5, "rad")
    assert CarDescription("dubins", 6.0, (-1.2, 1.2)).control_unit == "rad/s"


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"paths": {}}, "at least one path"),
        (
            {"paths": {"one": PATH, "other": replace(PATH, goal=())}},
            r"goals of one length; got one \[1.0, 0.0\], other \[\]",
        ),
        ({"off_track_m": 0.0}, "expected off_track_m, half a lane"),
        ({"off_track_m": float("inf")}, "expected off_track_m, half a lane"),
        ({"T_car_from_camera": np.eye(3)}, "rigid transform"),
        ({"T_car_from_camera": np.diag([1.0, -1.0, 1.0, 1.0])}, "rigid transform"),
        ({"T_car_from_camera": np.diag([2.0, 2.0, 2.0, 1.0])}, "rigid transform"),
    ],
)
def test_a_description_that_cannot_be_is_refused(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(WorldError, match=told):
        description(**changes)


@pytest.mark.parametrize(
    "make",
    [
        lambda: CarDescription("tank", 1.0, (-1.0, 1.0)),  # type: ignore[arg-type]
        lambda: CarDescription("dubins", 0.0, (-1.0, 1.0)),
        lambda: CarDescription("dubins", 1.0, (1.0, -1.0)),
        lambda: CarDescription("dubins", 1.0, (-1.0, 1.0), 0.5),
        lambda: CarDescription("ackermann", 1.0, (-1.0, 1.0)),
        lambda: Box((0.0, 0.0, 0.0), (1.0, 1.0, 0.0)),
        lambda: Box((0.0, 0.0, 0.0), (1.0, 1.0, float("nan"))),
    ],
)
def test_cars_and_boxes_that_cannot_be_are_refused(make: Any) -> None:
    with pytest.raises(WorldError, match="expected"):
        make()


@pytest.mark.parametrize(
    ("car", "told"),
    [
        (
            ("ackermann", 80.0, (-0.4, 0.4), 0.3),
            "speed_mps: expected at most 50 m/s, not km/h or mm/s; got 80",
        ),
        (("ackermann", 1.0, (-0.4, 0.4), 300.0), "wheelbase_m: expected at most 20 m, not cm or mm; got 300"),
        (
            ("ackermann", 1.0, (-23.0, 23.0), 0.3),
            "control_limits: expected at most 1.5708 rad, not degrees; got 23",
        ),
        (("dubins", 1.0, (-70.0, 70.0)), "control_limits: expected at most 20 rad/s, not degrees; got 70"),
    ],
)
def test_a_car_in_other_units_is_refused(car: Any, told: str) -> None:
    with pytest.raises(WorldError, match=f"^{told}$"):
        CarDescription(*car)


@pytest.mark.parametrize(
    "data",
    [
        {},
        [],
        {**description().to_dict(), "box": None},
        {**description().to_dict(), "car": {"kind": "dubins"}},
    ],
)
def test_other_data_is_no_description(data: Any) -> None:
    with pytest.raises(WorldError, match="as WorldDescription"):
        WorldDescription.from_dict(data)


def test_the_contract_names_its_members() -> None:
    names = members_of_a_world()
    assert {
        "describe",
        "photo_poses",
        "reset",
        "step",
        "observe",
        "observe_at",
        "photograph",
        "state",
        "blocked",
    } <= set(names)
    assert {"camera_pinhole", "photo_pinhole", "T_car_from_camera", "__enter__", "__exit__"} <= set(names)
    assert Traits() == Traits((), False, None)
