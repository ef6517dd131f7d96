"""Junctions and drives out of OpenDRIVE, read by the real client library; the truth is how the file was drawn."""

import math

import numpy as np
import pytest

from advnerf_core.driving.path import Arc, Line, Path
from hardware.worlds.carla.config import JunctionConfig
from hardware.worlds.carla.errors import CarlaMapError
from hardware.worlds.carla.junction import find_drives, list_junctions
from hardware.worlds.junction.paths import junction_paths


def drives_of(carla, junction, **settings):
    return find_drives(carla.Map("written", junction.text()), carla, wanted(**settings))


def wanted(**settings):
    return JunctionConfig(**{"max_height_range_m": 100.0, **settings})


def path_of(reference):
    pieces = [Line(s[1]) if s[0] == "line" else Arc(s[1], s[2]) for s in reference.segments]
    return Path.from_segments(reference.start_pose, pieces, closed=False)


@pytest.mark.parametrize("yaw_deg", [0.0, 15.0, 45.0, 180.0])
def test_the_junction_is_found(carla, TJunction, yaw_deg):
    text = TJunction(x_m=30.0, y_m=20.0, yaw_rad=math.radians(yaw_deg)).text()
    (info,) = list_junctions(carla.Map("written", text), carla)
    assert (info.id, info.arms, info.drives) == (100, 3, 1)
    assert (info.x_m, info.y_m) == pytest.approx(
        (30.0, -20.0), abs=6.0
    )  # mirrored; the box is not centred on the roads


@pytest.mark.parametrize(
    "place", [{}, {"x_m": 120.0, "y_m": -340.0, "z_m": 2.5, "yaw_rad": 2.4}], ids=["plain", "moved"]
)
def test_paths_are_those_of_the_simulated_intersection(carla, TJunction, place):
    """Wherever the junction lies: same frame, same names, same exits, same lanes; within the library's single precision."""
    drives = drives_of(carla, TJunction(**place), approach_m=24.0, beyond_m=30.0)
    truth = junction_paths(3.5, right_radius_m=8.25, left_radius_m=11.75, approach_m=24.0, beyond_m=30.0)
    for name, expected in truth.items():
        found = drives.paths[name]
        assert found.goal == expected.goal
        assert found.start_pose == pytest.approx(expected.start_pose, abs=1e-3)
        if name != "straight":  # ours is as long after the junction as the others
            assert found.length_m == pytest.approx(expected.length_m, abs=0.02)
        along = np.arange(0.0, expected.length_m if name != "straight" else 60.0, 0.5)
        points = np.array([expected.pose_at(s) for s in along])
        at = path_of(found).project(points[:, :2])
        assert np.abs(at.cte_m).max() < 0.02, name
        assert np.abs(np.angle(np.exp(1j * (at.heading_rad - points[:, 2])))).max() < 0.02, name
    assert (drives.lane_width_m, drives.right_hand) == (pytest.approx(3.5), True)
    assert drives.height_range_m == pytest.approx(0.0, abs=1e-5)


def test_frame_lies_where_the_roads_meet(carla, TJunction):
    drives = drives_of(carla, TJunction(x_m=120.0, y_m=-340.0, z_m=2.5, yaw_rad=2.4))
    T = drives.frame.T_mirrored_from_world
    np.testing.assert_allclose(T[:3, 3], [120.0, -340.0, 2.5], atol=1e-3)
    np.testing.assert_allclose(T[:2, 0], [math.cos(2.4), math.sin(2.4)], atol=1e-5)


def test_traffic_on_the_left(carla, TJunction):
    drives = drives_of(carla, TJunction(left_hand=True))
    assert not drives.right_hand
    assert drives.paths["straight"].start_pose == pytest.approx((-24.0, 1.75, 0.0), abs=1e-3)
    assert drives.paths["left"].start_pose == pytest.approx((-1.75, -24.0, math.pi / 2), abs=1e-3)


def test_a_bent_road_is_followed(carla, TJunction):
    path = path_of(drives_of(carla, TJunction(bend_1pm=0.02), approach_m=60.0).paths["straight"])
    on_the_bend = path.pose_at(np.linspace(1.0, 45.0, 30))
    # The lane's middle is an arc outside the road's own, about the same centre: (-10, 50).
    np.testing.assert_allclose(np.hypot(on_the_bend[:, 0] + 10.0, on_the_bend[:, 1] - 50.0), 51.75, atol=0.03)


def test_a_slope_shows_in_the_height_range(carla, TJunction):
    drives = drives_of(carla, TJunction(slope=0.05), beyond_m=40.0)
    assert drives.height_range_m == pytest.approx(2.0, abs=1e-3)


def test_what_a_map_lacks_is_said(carla, TJunction):
    with pytest.raises(CarlaMapError, match=r"junction 7 in the map written, which has \[100\]"):
        drives_of(carla, TJunction(), id=7)
    with pytest.raises(CarlaMapError, match=r"one of the 1 sets of drives of junction 100 \(0 to 0\), got 1"):
        drives_of(carla, TJunction(), choice=1)
    with pytest.raises(CarlaMapError, match=r"expected 85.0 m of road before the junction .* found 20.0 m"):
        drives_of(carla, TJunction(arm_m=20.0), approach_m=95.0)
    with pytest.raises(CarlaMapError, match=r"behind the junction .* shorter beyond_m"):
        drives_of(carla, TJunction(arm_m=30.0))
    with pytest.raises(CarlaMapError, match=r"at least 10.0 m from its middle, got approach_m = 5.0 m"):
        drives_of(carla, TJunction(), approach_m=5.0)
    only_a_road = (
        TJunction()
        .text()
        .split('<road name="r2"')[0]
        .replace('<successor elementType="junction" elementId="100"/>', "")
    )
    with pytest.raises(CarlaMapError, match="junction of three roads in the map road, found none"):
        find_drives(carla.Map("road", only_a_road + "</OpenDRIVE>"), carla, wanted())


def test_of_several_junctions_the_first_that_will_do_is_taken(carla, TJunction):
    """One file with a hill's junction (100) and a flat one (200) beside it."""
    both = carla.Map("both", TJunction(slope=0.05).text(TJunction(y_m=-400.0, first_id=100)))
    assert [info.id for info in list_junctions(both, carla)] == [100, 200]
    assert find_drives(both, carla, wanted()).junction_id == 100
    drives = find_drives(both, carla, wanted(max_height_range_m=0.15))
    assert drives.junction_id == 200
    assert drives.paths["left"].start_pose == pytest.approx((1.75, -24.0, math.pi / 2), abs=1e-3)
    with pytest.raises(CarlaMapError, match=r"none of 2 junctions will do; this is the first"):
        find_drives(both, carla, wanted(max_height_range_m=0.15, beyond_m=300.0))
