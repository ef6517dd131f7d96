"""Worlds of other people as they are installed: skipped where they are not (``advnerf world install NAME``)."""

import math
from pathlib import Path

import numpy as np
import pytest

from hardware.worlds.duckietown.config import DuckietownConfig
from hardware.worlds.duckietown.world import Duckietown
from hardware.worlds.environments import ENVIRONMENTS
from hardware.worlds.metadrive.config import CarConfig, MetaDriveConfig, RoadConfig
from hardware.worlds.metadrive.world import MetaDrive
from hardware.worlds.remote_errors import RemoteWorldError
from hardware.worlds.world import NotOpenError, WorldError
from nodes.lab.worlds.check import check_world
from nodes.lab.worlds.named import read_world
from nodes.runtime.config import Document, apply_overrides

installed = {
    name: pytest.mark.skipif(each.state != "installed", reason=f"advnerf world install {name}")
    for name, each in ENVIRONMENTS.items()
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        pytest.param("metadrive", (), marks=installed["metadrive"]),
        pytest.param("metadrive", ("road.blocks=XO", "road.seed=17"), marks=installed["metadrive"]),
        pytest.param("metadrive", ("car.own=false",), marks=installed["metadrive"]),
        pytest.param("metadrive", ("traffic_density=0.3",), marks=installed["metadrive"]),
        pytest.param("duckietown", (), marks=installed["duckietown"]),
        pytest.param("duckietown", ("map_name=loop_obstacles",), marks=installed["duckietown"]),
    ],
)
def test_a_foreign_world_keeps_the_contract(kind: str, changes: tuple[str, ...]) -> None:
    document = Document({"kind": kind}, "test")
    apply_overrides(document, changes)
    findings = check_world(read_world(document, Path.cwd()))
    assert [f"{each.name}: {each.text}" for each in findings if not each.met] == []
    assert findings[-1].name == "panels"


@pytest.mark.slow
@installed["metadrive"]
def test_the_ideal_car_is_the_one_that_is_described_and_the_own_one_lags() -> None:
    ends = {}
    for own in (False, True):
        with MetaDrive(MetaDriveConfig(car=CarConfig(own=own))) as world:
            car = world.describe().car
            world.reset(30.0, -3.5, 0.0)
            for _ in range(10):
                state = world.step(0.1, 6.0, 0.1)
            ends[own] = state
    assert car.wheelbase_m is not None
    turned = 6.0 * math.tan(0.1) / car.wheelbase_m
    assert ends[False].yaw_rad == pytest.approx(turned, rel=1e-9)
    radius = 6.0 / turned
    assert (ends[False].x_m, ends[False].y_m) == pytest.approx(
        (30.0 + radius * math.sin(turned), -3.5 + radius * (1.0 - math.cos(turned))), abs=1e-9
    )
    assert 0.8 * turned < ends[True].yaw_rad < 0.98 * turned


@pytest.mark.slow
@installed["metadrive"]
def test_a_road_is_the_same_in_every_process_and_another_seed_is_another_road() -> None:
    def route(seed: int) -> object:
        with MetaDrive(MetaDriveConfig(road=RoadConfig(blocks="CC", seed=seed))) as world:
            return world.describe().to_dict(), world.observe_at(35.0, -3.5, 0.0)[0]

    first, again, other = route(4), route(4), route(7)
    assert first[0] == again[0]  # type: ignore[index]
    assert np.array_equal(first[1], again[1])  # type: ignore[index]
    assert first[0] != other[0]  # type: ignore[index]


@pytest.mark.slow
@installed["metadrive"]
def test_a_road_that_ends_too_early_is_refused() -> None:
    world = MetaDrive(MetaDriveConfig(road=RoadConfig(blocks="S", from_m=500.0)))
    with pytest.raises(WorldError, match="add blocks, or begin earlier") as refused, world:
        raise AssertionError("it was opened")
    assert not isinstance(refused.value, RemoteWorldError)
    assert world.server is None
    with pytest.raises(NotOpenError):
        world.describe()


@pytest.mark.slow
@installed["metadrive"]
def test_a_lane_that_ends_is_refused_and_the_one_beside_it_is_driven() -> None:
    with pytest.raises(WorldError, match=r"name another one in road\.lane"):
        MetaDrive(MetaDriveConfig(road=RoadConfig(blocks="y", seed=5))).__enter__()
    with MetaDrive(MetaDriveConfig(road=RoadConfig(blocks="y", seed=5, lane=0))) as world:
        assert world.describe().paths["route"].length_m > 40.0


@pytest.mark.slow
@installed["duckietown"]
def test_a_map_without_a_way_round_is_refused() -> None:
    with pytest.raises(WorldError, match="name another one, such as small_loop"):
        Duckietown(DuckietownConfig(map_name="straight_road")).__enter__()
