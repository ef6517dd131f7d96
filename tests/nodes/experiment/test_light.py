"""The light on a panel: measured with plain colours, against the closed form of the room's lights and against the room's own pictures."""

from pathlib import Path

import numpy as np
import pytest
import torch

from advnerf_core.attack.artifact import AttackFile
from advnerf_core.attack.spaces.displayed import DisplayedSensor
from advnerf_core.attack.spaces.space import ColourSpace, NamedObject
from advnerf_core.geometry import planar_pose
from advnerf_core.scene.surrogate import Surrogate
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.lab import Lab
from hardware.worlds.lab.world import shading
from nodes.experiment.show.deployed import DressedScene
from nodes.experiment.show.light import light_remark, measure_light
from nodes.experiment.show.native import NativeScene
from nodes.experiment.show.objects import placed_objects
from nodes.experiment.steps.pipeline import stages_of
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError

LAUNCH = Path(__file__).parents[3] / "launch"
BOARD = "{name: board, kind: panel, x_m: 2.0, y_m: -2.8, yaw_rad: 2.8, scale: 0.3}"
CHANGES = [
    "deploy.through=world",
    "space.cells=0",
    "object.panel_resolution=8",
    "policy.naive_steps=0",
    "horizon=40",
    "carrier={kind: composed, training: native, response: measured}",
]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("run")
    experiment = load_experiment(
        LAUNCH / "room.experiment.yaml", "demo", [*CHANGES, f"objects=[{BOARD}]"], folder
    )
    with Lab(LabConfig(supersampling=1)) as world:
        yield experiment, world, measure_light(experiment, world)


def test_the_light_is_that_of_the_rooms_lamps(measured) -> None:
    experiment, _, fit = measured
    factor = shading(experiment.objects[0].T_world_from_face[:3, 0])
    assert 0.7 < factor < 0.95
    for painted in ([1.0, 1.0, 1.0], [0.5, 0.5, 0.5], [0.8, 0.3, 0.6]):
        assert fit.model.forward(np.array(painted)) == pytest.approx(factor * np.array(painted), abs=0.01)
    assert fit.rmse(True) < 0.01


def test_what_is_seen_of_a_texture_is_what_the_room_draws(measured) -> None:
    experiment, world, fit = measured
    (panel,) = placed_objects(experiment)
    surrogate = Surrogate(lambda poses, pinhole: None, experiment.view.pinhole, experiment.mount, [panel])
    space = ColourSpace(surrogate, [NamedObject("board", "")], fit.model)
    assert isinstance(space.sensor, DisplayedSensor)
    theta = 2.0 * torch.randn(8, 8, 3, generator=torch.Generator().manual_seed(0))
    attack = AttackFile(
        method="gradient", space=space.name, objects=space.attacked(theta), face=None, camera=experiment.view.pinhole,
        scene_sha256="", policy_sha256="", config_sha256="", seed=0, predicted_total_cte_m=None, software_version="",
    )  # fmt: skip
    found = space.restored(attack)
    assert found.painted is not None
    assert torch.equal(found.painted, theta)
    state = np.array([0.9, -2.0, 0.0])
    native, composed = (kind(world, experiment.view, [panel]) for kind in (NativeScene, DressedScene))
    real = native.camera_image(state, found.painted).astype(int)
    NativeScene(world, experiment.view, []).camera_image(state, None)
    inside = (
        np.abs(composed.camera_image(state, torch.full_like(theta, 9.0)).astype(int) - real).max(axis=2) > 60
    )
    assert inside.sum() > 300
    lit, unlit = (
        float(np.median(np.abs(composed.camera_image(state, colours).astype(int) - real)[inside]))
        for colours in (found.colours, found.painted)
    )
    assert lit < 4.0
    assert unlit > 3.0 * lit
    # Without an attack the panel is grey in the same light.
    plain = space.plain
    assert torch.sigmoid(plain.colours).mean() < torch.sigmoid(plain.painted).mean() - 0.03


def test_light_needs_a_panel_and_a_world_that_takes_it(tmp_path: Path) -> None:
    def load(name: str, *changes: str):
        return load_experiment(LAUNCH / f"{name}.experiment.yaml", "demo", list(changes), tmp_path / name)

    with pytest.raises(ConfigError, match=r"training native with carrier\.response measured"):
        load("room", *CHANGES[:-1], "carrier={kind: composed, response: measured}", f"objects=[{BOARD}]")
    board = "objects=[{name: board, kind: panel, x_m: 12.0, y_m: 5.0, yaw_rad: -2.0}]"
    with pytest.raises(
        ConfigError, match=r"own scene \(add_panel\) with carrier.training native, got junction"
    ):
        load("junction", *CHANGES[2:], board)
    with (
        Lab(LabConfig(supersampling=1)) as world,
        pytest.raises(ConfigError, match="hidden, turned away or too small"),
    ):
        measure_light(load("room", *CHANGES, f"objects=[{BOARD.replace('2.8, scale', '0.3, scale')}]"), world)
    plain = load("room", *CHANGES[:-1], "carrier={kind: composed, training: native}", f"objects=[{BOARD}]")
    measured = load("room", *CHANGES, f"objects=[{BOARD}]")
    assert stages_of(plain)[0].settings != stages_of(measured)[0].settings


def test_the_region_is_where_the_camera_sees_the_panel(measured) -> None:
    from nodes.experiment.show.light import _region

    experiment, _, _ = measured
    thing, pose = experiment.objects[0], (0.0, -2.0, 0.0)
    region = _region(experiment, thing, pose)
    T_camera_from_face = np.linalg.inv(planar_pose(*pose) @ experiment.mount) @ thing.T_world_from_face
    middle = experiment.camera.project(T_camera_from_face[:3, 3])
    rows, columns = np.nonzero(region)
    assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx(
        tuple(middle), abs=2.5
    )  # the nearer half is larger


def test_light_that_depends_on_where_the_car_is_is_refused_in_words_for_a_world(
    measured, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As that of a lamp on the car."""
    experiment, world, _ = measured
    seen = world.observe_at

    def with_a_lamp(x_m: float, y_m: float, yaw_rad: float, depth: bool = True):
        rgb, found = seen(x_m, y_m, yaw_rad, depth)
        return (rgb * (0.7 + 0.1 * np.clip(x_m, -1.0, 1.0))).astype(np.uint8), found

    monkeypatch.setattr(world, "observe_at", with_a_lamp)
    with pytest.raises(
        ConfigError, match=r"does not depend on where the car is.*set carrier\.response=identity$"
    ):
        measure_light(experiment, world)


def test_a_panel_that_the_world_shows_darker_than_the_learned_scene_is_told(
    measured, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was found in its own colours did next to nothing in Duckietown, where panels are 0.56 times as bright."""
    experiment, world, _ = measured
    assert light_remark(experiment, world) == ""
    seen, factor = world.observe_at, shading(experiment.objects[0].T_world_from_face[:3, 0])

    def at_dusk(x_m: float, y_m: float, yaw_rad: float, depth: bool = True):
        rgb, found = seen(x_m, y_m, yaw_rad, depth)
        return (rgb * 0.5).astype(np.uint8), found

    monkeypatch.setattr(world, "observe_at", at_dusk)
    told = light_remark(experiment, world)
    assert f"times as bright: board {0.5 * factor:.1f}" in told
    assert "set carrier.response=measured (for one panel)" in told
    monkeypatch.undo()
    assert light_remark(experiment, world) == "", "the panel was taken away, and is put there again"
