"""Worlds of other people as they are installed: skipped where they are not (``advnerf scene world install NAME``)."""

import math
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.documents import Document
from advnerf_core.geometry import make_transform, rotation_z
from hardware.worlds.duckietown.config import DuckietownConfig
from hardware.worlds.duckietown.world import Duckietown
from hardware.worlds.environments import ENVIRONMENTS
from hardware.worlds.filament.config import FilamentConfig
from hardware.worlds.filament.world import Filament
from hardware.worlds.lab.lab import Lab
from hardware.worlds.metadrive.config import MetaDriveCarConfig, MetaDriveConfig, MetaDriveRoadConfig
from hardware.worlds.metadrive.world import MetaDrive
from hardware.worlds.remote_errors import RemoteWorldError
from hardware.worlds.world import NotOpenError, Panel, WorldError
from nodes.lab.worlds.check import check_world
from nodes.lab.worlds.named import read_world
from nodes.lab.worlds.panels import sheet
from nodes.runtime.config import apply_overrides

installed = {
    name: pytest.mark.skipif(each.state != "installed", reason=f"advnerf scene world install {name}")
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
        pytest.param("filament", (), marks=installed["filament"]),
    ],
)
def test_a_foreign_world_keeps_the_contract(kind: str, changes: tuple[str, ...]) -> None:
    document = Document({"kind": kind}, "test")
    apply_overrides(document, changes)
    findings = check_world(read_world(document, Path.cwd()))
    assert [f"{each.name}: {each.text}" for each in findings if not each.met] == []
    assert [each.name for each in findings[-2:]] == ["panels", "meshes"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", [pytest.param(name, marks=mark) for name, mark in installed.items()])
def test_a_mesh_has_the_light_of_a_panel_in_its_place(kind: str) -> None:
    with read_world(Document({"kind": kind}, "test"), Path.cwd()).make() as world:
        described = world.describe()
        x, y, yaw = next(iter(described.paths.values())).start_pose
        ahead_m, side_m = 4.0 * described.off_track_m, described.off_track_m
        T = make_transform(rotation_z(yaw + math.pi - 0.3), [0.0, 0.0, 0.6 * side_m])
        T[:2, 3] = x + ahead_m * math.cos(yaw), y + ahead_m * math.sin(yaw)
        panel, texture = Panel(T, side_m, side_m), np.full((8, 8, 3), (200, 90, 40), np.uint8)
        pictures = [world.observe_at(x, y, yaw, depth=False)[0].astype(int)]
        for put in (
            lambda rgb: world.add_panel("it", panel, rgb),
            lambda rgb: world.add_mesh("it", None if rgb is None else sheet(panel, rgb)),
        ):
            put(texture)
            pictures.append(world.observe_at(x, y, yaw, depth=False)[0].astype(int))
            put(None)
        bare, as_panel, as_mesh = pictures
        shown = (as_panel != bare).any(axis=-1) & (as_mesh != bare).any(axis=-1)
        assert shown.sum() > 500
        assert np.abs(as_panel - as_mesh)[shown].mean() < 0.5


@pytest.mark.slow
@installed["metadrive"]
def test_the_ideal_car_is_the_one_that_is_described_and_the_own_one_lags() -> None:
    ends = {}
    for own in (False, True):
        with MetaDrive(MetaDriveConfig(car=MetaDriveCarConfig(own=own))) as world:
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
        with MetaDrive(MetaDriveConfig(road=MetaDriveRoadConfig(blocks="CC", seed=seed))) as world:
            return world.describe().to_dict(), world.observe_at(35.0, -3.5, 0.0)[0]

    first, again, other = route(4), route(4), route(7)
    assert first[0] == again[0]  # type: ignore[index]
    # As docs/foreign_worlds.md promises: samples on edges may fall on the other side in another process.
    assert np.mean(np.any(first[1] != again[1], axis=-1)) <= 1e-3  # type: ignore[index]
    assert first[0] != other[0]  # type: ignore[index]


@pytest.mark.slow
@installed["metadrive"]
def test_a_road_that_ends_too_early_is_refused() -> None:
    world = MetaDrive(MetaDriveConfig(road=MetaDriveRoadConfig(blocks="S", from_m=500.0)))
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
        MetaDrive(MetaDriveConfig(road=MetaDriveRoadConfig(blocks="y", seed=5))).__enter__()
    with MetaDrive(MetaDriveConfig(road=MetaDriveRoadConfig(blocks="y", seed=5, lane=0))) as world:
        assert world.describe().paths["route"].length_m > 40.0


@pytest.mark.slow
@installed["duckietown"]
def test_a_map_without_a_way_round_is_refused() -> None:
    with pytest.raises(WorldError, match="name another one, such as small_loop"):
        Duckietown(DuckietownConfig(map_name="straight_road")).__enter__()


@pytest.mark.slow
@installed["filament"]
def test_another_renderer_changes_the_colours_and_neither_depth_nor_dynamics() -> None:
    with Filament() as drawn, Lab() as lab:
        told, expected = drawn.describe().to_dict(), lab.describe().to_dict()
        assert told.pop("facts") == {"simulator": "Filament of MuJoCo 4.0.0"}
        assert told == {key: value for key, value in expected.items() if key != "facts"}
        for world in (drawn, lab):
            world.reset(-1.1, -2.0, 0.0)
        for steering in (0.2, -0.1, 0.3):
            assert drawn.step(steering, 0.8, 0.1) == lab.step(steering, 0.8, 0.1)
        (rgb, depth), (lab_rgb, lab_depth) = drawn.observe(), lab.observe()
        apart = np.abs(depth / lab_depth - 1.0)
        assert np.quantile(apart, 0.99) < 1e-3
        greys = [each.mean(axis=-1).ravel() for each in (rgb, lab_rgb)]
        assert np.corrcoef(*greys)[0, 1] > 0.8
        assert 2.0 < np.abs(rgb.astype(float) - lab_rgb).mean() < 40.0


@pytest.mark.slow
@installed["filament"]
def test_the_monitor_shows_a_picture_and_a_drive_whose_renderer_died_ends() -> None:
    with Filament() as world:
        place = (0.9, 2.0, 0.9)
        idle = world.observe_at(*place, depth=False)[0]
        world.show("monitor", np.full((4, 4, 3), (250, 20, 20), np.uint8))
        red = world.observe_at(*place, depth=False)[0]
        changed = (red != idle).any(axis=-1)
        assert changed.sum() > 500
        assert red[changed].mean(axis=0)[0] > 3.0 * red[changed].mean(axis=0)[1]
        world.reset(-1.1, -2.0, 0.0)
        assert world.server is not None
        world.server.kill()
        with pytest.raises(RemoteWorldError):
            world.observe()
        with pytest.raises(RemoteWorldError, match="call reset first"):
            world.step(0.0, 0.8, 0.1)
        world.reset(-1.1, -2.0, 0.0)
        assert np.array_equal(world.observe_at(*place, depth=False)[0], red)
        world.show("monitor", None)
        assert np.array_equal(world.observe_at(*place, depth=False)[0], idle)
        with pytest.raises(WorldError, match="a screen of the lab"):
            world.show("board", None)


@pytest.mark.slow
@installed["filament"]
def test_the_back_of_a_panel_is_plain() -> None:
    face = np.eye(4)
    face[:3, 3] = 0.3, -2.0, 0.3
    with Filament() as world:
        world.add_panel("red", Panel(face, 0.6, 0.4), np.full((8, 8, 3), (255, 0, 0), np.uint8))
        back = world.observe_at(-1.1, -2.0, 0.0, depth=False)[0][60:70, 160:176]
        assert np.ptp(back.astype(int), axis=-1).max() < 40
        face[:2, :2] = -np.eye(2)
        world.add_panel("red", Panel(face, 0.6, 0.4), np.full((8, 8, 3), (255, 0, 0), np.uint8))
        front = world.observe_at(-1.1, -2.0, 0.0, depth=False)[0][60:70, 160:176]
        assert (front[..., 0] > 2 * front[..., 1]).all()


def test_optics_that_the_twin_computes_are_refused() -> None:
    with pytest.raises(ValueError, match="no monitor_optics"):
        FilamentConfig.model_validate({"lab": {"monitor_optics": {"response": 2.2}}})
