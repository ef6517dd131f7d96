"""Panels in a world's own scene, against the same panels composed by depth."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from advnerf_core.attack.spaces.space import ColourSpace, NamedObject
from advnerf_core.fields.voxel_grid import cube_face_object
from advnerf_core.geometry import make_transform, planar_pose, rotation_z
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.surface import unwrapped
from advnerf_core.objects.voxel.build import build_from_mesh
from advnerf_core.objects.voxel.generators import hydrant
from advnerf_core.objects.voxel.mesh import stand
from advnerf_core.policies.view import PolicyView
from advnerf_core.scene.surrogate import Surrogate
from nodes.experiment.plan.placed import PlacedObject
from nodes.experiment.show.deployed import DressedScene
from nodes.experiment.show.native import NativeScene
from nodes.experiment.show.objects import placed_objects
from nodes.experiment.show.standing import DeployedFrames
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError
from tests.support.remote.flat_world import FlatConfig, FlatWorld

LAUNCH = Path(__file__).parents[3] / "launch"
STATE = np.array([0.0, 0.0, 0.3])


@pytest.fixture(scope="module")
def world():
    with FlatWorld(FlatConfig()) as world:
        world.reset(*map(float, STATE))
        yield world


def face(side_m: float = 1.5, x_m: float = 4.0):
    """A panel ahead of the car, which looks back at it."""
    yaw = 0.3 + np.pi - 0.2
    return cube_face_object(
        side_m, 8, (0.5, 0.5, 0.5), make_transform(rotation_z(yaw), [x_m, 1.2, 0.5 * side_m + 0.05])
    )


def quarters() -> torch.Tensor:
    """Red, green, blue and white in the corners of a texture: a mirrored or turned one is another picture."""
    theta = torch.full((8, 8, 3), -9.0)
    theta[:4, :4, 0] = theta[:4, 4:, 1] = theta[4:, :4, 2] = 9.0
    theta[4:, 4:] = 9.0
    return theta


def test_the_world_shows_what_composition_draws(world: Any) -> None:
    view = PolicyView(world.camera_pinhole)
    native, composed = NativeScene(world, view, [face()]), DressedScene(world, view, [face()])
    NativeScene(world, view, []).camera_image(STATE, None)  # composed over a bare scene
    bare = world.observe_at(*map(float, STATE), depth=False)[0]
    drawn = composed.camera_image(STATE, quarters())
    shown = native.camera_image(STATE, quarters())
    inside = np.abs(drawn.astype(int) - bare).max(axis=2) > 40
    assert 1500 < inside.sum() < 20000
    difference = np.abs(drawn.astype(int) - shown).mean(axis=2)
    assert np.median(difference[inside]) <= 3.0
    assert (difference[inside] > 30.0).mean() < 0.12  # edges of panel and quarters
    assert (difference[~inside] > 30.0).mean() < 0.01
    # What the policy sees, now and from a state, is cut out of the same picture.
    assert np.array_equal(native.seen_now(quarters()), view.image(shown))
    assert np.array_equal(native.policy_images(native.prepare(STATE[None]), quarters())[0], view.image(shown))


def test_solid_objects_stand_in_the_world_as_meshes(world: Any) -> None:
    """An object of voxels in its true surface, and a mesh, against both drawn by composition."""
    view, surface = PolicyView(world.camera_pinhole), stand(hydrant(), height_m=1.0)
    place = make_transform(rotation_z(0.4), [3.0, 0.9, 0.05])
    voxels = build_from_mesh(surface, "hydrant", 40, steps=0).placed(place, 1.3)
    height = np.argwhere(voxels.slots < voxels.free_count)[:, 2] / voxels.slots.shape[2]
    upper = torch.zeros(voxels.theta_shape)
    rows = voxels.slots[voxels.slots < voxels.free_count]
    upper[rows, 0] = torch.from_numpy(np.where(height > 0.5, 9.0, -9.0).astype(np.float32))
    upper[:, 1:] = -9.0
    mesh = MeshField(unwrapped(surface, 32), place, 1.3)
    NativeScene(world, view, []).camera_image(STATE, None)
    bare = world.observe_at(*map(float, STATE), depth=False)[0]
    for field, theta in (
        (voxels, upper),
        (mesh, torch.from_numpy(mesh.plain_theta.reshape(mesh.theta_shape))),
    ):
        drawn = DressedScene(world, view, [field]).camera_image(STATE, theta)
        native = NativeScene(world, view, [field], [surface])
        shown = native.camera_image(STATE, theta)
        NativeScene(world, view, []).camera_image(STATE, None)
        inside, seen = (np.abs(each.astype(int) - bare).max(axis=2) > 25 for each in (drawn, shown))
        assert inside.sum() > 1500
        assert (inside & seen).sum() > 0.93 * (inside | seen).sum()
        difference = np.abs(drawn.astype(int) - shown).mean(axis=2)[inside & seen]
        assert np.median(difference) <= 3.0
        assert (difference > 30.0).mean() < 0.12  # edges
    with pytest.raises(ConfigError, match="whose meshes are known"):
        NativeScene(world, view, [voxels])


def test_scenes_that_share_a_world_do_not_see_each_others_panels(world: Any) -> None:
    view = PolicyView(world.camera_pinhole)
    one, two, none = (
        NativeScene(world, view, panels) for panels in ([face()], [face(0.8), face(0.8, 5.0)], [])
    )
    bare = none.camera_image(STATE, None)
    first = one.camera_image(STATE, quarters())
    second = two.camera_image(STATE, torch.zeros(2 * 64, 3))
    assert np.array_equal(one.camera_image(STATE, quarters()), first)
    assert np.array_equal(two.camera_image(STATE, torch.zeros(2 * 64, 3)), second)
    assert np.array_equal(none.camera_image(STATE, None), bare)
    assert len({picture.tobytes() for picture in (bare, first, second)}) == 3
    # Without an attack a panel has its plain colour.
    grey = one.camera_image(STATE, None)
    changed = (grey != bare).any(axis=2)
    assert np.median(grey[changed]) == pytest.approx(128, abs=2)


def test_what_cannot_be_shown_is_refused(world: Any, make_wall: Any) -> None:
    view = PolicyView(world.camera_pinhole)
    with pytest.raises(ConfigError, match="a world that takes panels"):
        NativeScene(make_wall(20.0), view, [face()])
    solid = cube_face_object(1.0, 4)
    flat = dataclasses.replace(solid, theta_shape=(16, 3))
    with pytest.raises(ConfigError, match="expected panels, or objects whose meshes"):
        NativeScene(world, view, [flat])


def test_a_panel_is_an_object_of_an_experiment(tmp_path: Path) -> None:
    board = {
        "name": "board",
        "kind": "panel",
        "x_m": 12.0,
        "y_m": 5.0,
        "z_m": 0.12,
        "yaw_rad": -2.0,
        "scale": 1.5,
    }
    changes = [f"objects=[{board}]".replace("'", ""), "object.panel_resolution=16"]
    experiment = load_experiment(LAUNCH / "junction.experiment.yaml", "demo", changes, tmp_path)
    (field,) = placed_objects(experiment)
    assert field.theta_shape == (16, 16, 3)
    assert (field.box_max - field.box_min)[1:].tolist() == [3.0, 3.0]
    assert field.T_world_from_object[:3, 3].tolist() == [12.0, 5.0, 0.12 + 1.5]
    assert field.T_world_from_object[:3, 0] == pytest.approx([np.cos(-2.0), np.sin(-2.0), 0.0])
    assert PlacedObject(**board).side_m == 3.0
    # Its size goes into the attack file, whose scale says nothing of it.
    surrogate = Surrogate(lambda poses, pinhole: None, experiment.view.pinhole, np.eye(4), [field])
    (attacked,) = ColourSpace(surrogate, [NamedObject("board", "")]).attacked(torch.zeros(16, 16, 3))
    assert (attacked.size_m, attacked.scale) == ((3.0, 3.0), 1.0)
    with pytest.raises(ConfigError, match=r"takes car_.* into its own scene .add_mesh.*got junction"):
        load_experiment(LAUNCH / "junction.experiment.yaml", "demo", ["carrier.kind=native"], tmp_path)
    naive = [
        *changes,
        "carrier={kind: composed, training: native}",
        "policy.own_car=true",
        "policy.naive_steps=10",
    ]
    with pytest.raises(ConfigError, match="would learn from random textures"):
        load_experiment(LAUNCH / "junction.experiment.yaml", "demo", naive, tmp_path)
    mesh = [*changes, "space={kind: mesh_texture}"]
    with pytest.raises(ConfigError, match="objects with a mesh"):
        load_experiment(LAUNCH / "junction.experiment.yaml", "demo", mesh, tmp_path)


def test_what_is_composed_or_searched_over_a_world_sees_it_bare(world: Any) -> None:
    """Cells share an open world: what one has put there is not in the background of the next."""
    view = PolicyView(world.camera_pinhole)
    NativeScene(world, view, []).camera_image(STATE, None)
    pose = planar_pose(*STATE)[None] @ world.T_car_from_camera
    bare = DeployedFrames(world, view)(pose, view.pinhole)[0]
    composed = DressedScene(world, view, [face()])
    alone = composed.camera_image(STATE, quarters())
    shown = NativeScene(world, view, [face(0.7)])
    shown.camera_image(STATE, quarters())
    assert np.array_equal(DeployedFrames(world, view)(pose, view.pinhole)[0], bare)
    shown.camera_image(STATE, quarters())
    assert np.array_equal(composed.camera_image(STATE, quarters()), alone)
    world.reset(*map(float, STATE))
    shown.camera_image(STATE, quarters())
    assert np.array_equal(
        composed.seen_now(quarters()), composed.policy_images(composed.prepare(STATE[None]), quarters())[0]
    )


def test_a_change_that_fails_half_way_is_made_good(world: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    view = PolicyView(world.camera_pinhole)
    two = NativeScene(world, view, [face(0.8), face(0.8, 5.0)])
    NativeScene(world, view, []).camera_image(STATE, None)
    wanted = two.camera_image(STATE, torch.zeros(2 * 64, 3))
    NativeScene(world, view, []).camera_image(STATE, None)
    put, count = world.add_panel, iter(range(9))

    def fails_once(*arguments: Any) -> None:
        if next(count) == 1:
            raise RuntimeError("the simulator ended")
        put(*arguments)

    monkeypatch.setattr(world, "add_panel", fails_once)
    with pytest.raises(RuntimeError, match="the simulator ended"):
        two.camera_image(STATE, torch.zeros(2 * 64, 3))
    assert np.array_equal(two.camera_image(STATE, torch.zeros(2 * 64, 3)), wanted)
