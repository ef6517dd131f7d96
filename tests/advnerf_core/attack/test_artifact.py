import dataclasses
import subprocess
import sys

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.numpy import save_file

from advnerf_core.attack.artifact import (
    AttackedObject,
    AttackFileError,
    attack_from_bytes,
    face_texture,
    load_attack,
    save_attack,
)
from advnerf_core.fields.voxel_grid import face_corners_in_object, squash
from advnerf_core.geometry import Pinhole, planar_pose
from tests.support.faces import face_attack

THETA = np.random.default_rng(0).normal(size=(16, 16, 3)).astype(np.float32)


def attack(theta=THETA, texture=None, **changes):
    base = face_attack(
        method="gradient",
        theta=theta,
        texture=texture,
        size_m=(0.8, 0.8),
        T_world_from_object=np.eye(4),
        subject="board",
        corners_in_subject=face_corners_in_object(0.8),
        camera=Pinhole(200, 66, 103.6, 103.4, 100, 32),
        scene_sha256="a" * 64,
        policy_sha256="b" * 64,
        config_sha256="c" * 64,
        seed=3,
        predicted_total_cte_m=9.25,
        software_version="0.1.0",
        extra={"iterations": 50},
    )
    return dataclasses.replace(base, **changes)


def of_two():
    """A ball whose vertices moved, and a hydrant elsewhere; nothing that a projection could show."""
    there = planar_pose(1.25, -2.5, 0.75)
    ball = AttackedObject("ball", np.ones((12, 3), np.float32), np.eye(4), 1.0, "d" * 64, b"glTF and more")
    hydrant = AttackedObject("hydrant", np.zeros((4, 5, 3), np.float32), there, 1.5, "e" * 64)
    return attack(space="mesh_shape", objects=(ball, hydrant), face=None)


def same(a, b):
    if dataclasses.is_dataclass(a) and not isinstance(a, type):
        return type(a) is type(b) and all(
            same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a)
        )
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b


@pytest.mark.parametrize("saved", [attack(), of_two()], ids=["face", "two objects"])
def test_round_trip_keeps_everything_and_the_id(saved, tmp_path):
    path = tmp_path / "attack.safetensors"
    assert save_attack(path, saved) == saved.attack_id
    loaded = load_attack(path)
    assert loaded.attack_id == saved.attack_id
    assert len(loaded.attack_id) == 12
    assert same(saved, loaded)
    assert same(saved, attack_from_bytes(path.read_bytes(), "the same"))
    assert [p.name for p in tmp_path.iterdir()] == ["attack.safetensors"]


def test_a_face_knows_its_carrier_and_other_attacks_have_none():
    face = attack()
    assert face.face_object is face.objects[0]
    assert same(face.required_face().texture, face_texture(THETA))
    with pytest.raises(
        AttackFileError,
        match="expected an attack with a face that can be shown, got one on the mesh_shape of ball, hydrant",
    ):
        of_two().required_face()
    assert of_two().objects[1].placement == pytest.approx((1.25, -2.5, 0.75, 1.5))


def test_the_same_attack_is_the_same_bytes(tmp_path):
    files = [tmp_path / f"{k}.safetensors" for k in range(8)]
    for file in files:
        save_attack(file, attack())
    assert len({file.read_bytes() for file in files}) == 1


def test_the_id_depends_on_every_part():
    ids = {attack().attack_id, attack(seed=4).attack_id, attack(policy_sha256="d" * 64).attack_id}
    ids.add(attack(theta=THETA + np.float32(1e-3), texture=face_texture(THETA)).attack_id)
    ids.add(attack(texture=255 - face_texture(THETA)).attack_id)
    ids.add(attack(space="places").attack_id)
    two = of_two()
    ids |= {two.attack_id, dataclasses.replace(two, objects=two.objects[::-1]).attack_id}
    other_mesh = dataclasses.replace(two.objects[0], glb=b"glTF and less")
    ids.add(dataclasses.replace(two, objects=(other_mesh, two.objects[1])).attack_id)
    assert len(ids) == 9


def test_a_changed_file_is_noticed(tmp_path):
    path = tmp_path / "attack.safetensors"
    save_attack(path, attack())
    with safe_open(path, framework="numpy") as handle:
        header, tensors = (
            handle.metadata(),
            {k: handle.get_tensor(k).copy() for k in ("objects.0.theta", "face.texture")},
        )
    tensors["face.texture"][0, 0, 0] ^= 1
    save_file(tensors, path, metadata=header)
    with pytest.raises(AttackFileError, match="changed after it was saved"):
        load_attack(path)


@pytest.mark.parametrize("content", [b"", b"not a safetensors file", b"\x10\x00\x00\x00\x00\x00\x00\x00{}"])
def test_garbage_gives_one_clear_error(tmp_path, content):
    path = tmp_path / "attack.safetensors"
    path.write_bytes(content)
    with pytest.raises(AttackFileError, match=r"cannot read .* as an attack file"):
        load_attack(path)


def test_the_size_of_a_panel_is_kept_and_files_without_one_keep_their_id(tmp_path):
    first, panel = of_two().objects
    sized = dataclasses.replace(of_two(), objects=(first, dataclasses.replace(panel, size_m=(2.8, 1.4))))
    assert save_attack(tmp_path / "attack.safetensors", sized) == sized.attack_id != of_two().attack_id
    assert [each.size_m for each in load_attack(tmp_path / "attack.safetensors").objects] == [
        None,
        (2.8, 1.4),
    ]
    assert of_two().attack_id == "e5a1f1c18a70"


def test_missing_truncated_and_foreign_files(tmp_path):
    with pytest.raises(AttackFileError, match="found none"):
        load_attack(tmp_path / "none.safetensors")
    path = tmp_path / "attack.safetensors"
    save_attack(path, attack())
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(AttackFileError, match="cannot read"):
        load_attack(path)
    save_file({"weights": np.zeros(3)}, path)
    with pytest.raises(AttackFileError, match=r"expected .* to be of format"):
        load_attack(path)


def test_impossible_attacks_are_refused():
    with pytest.raises(AttackFileError, match="name of a method"):
        attack(method="")
    with pytest.raises(AttackFileError, match="at least one object"):
        attack(objects=(), face=None)
    with pytest.raises(AttackFileError, match="a face of object 0 to 0, got 1"):
        attack(face=dataclasses.replace(attack().face, carried_by=1))
    with pytest.raises(AttackFileError, match=r"texture \[H, W, 3\]"):
        attack(texture=np.zeros((0, 0, 3), np.uint8))
    with pytest.raises(AttackFileError, match="finite"):
        attack(theta=np.full((4, 4, 3), np.nan, np.float32))


def test_texture_is_the_squashed_grid_interpolated_at_cell_centres():
    theta = torch.randn(4, 4, 3, dtype=torch.float64)
    texture = face_texture(theta.numpy(), 512)
    # The pixel centres of a 512 texture do not meet cell centres; an odd multiple does.
    odd = face_texture(theta.numpy(), 4 * 27)
    np.testing.assert_allclose(odd[13::27, 13::27], 255 * squash(theta).numpy(), atol=0.51)
    assert texture.shape == (512, 512, 3)


def test_loading_needs_no_torch():
    code = "import sys, advnerf_core.attack.artifact, advnerf_core.attack.projection; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", ["x/../../../escaped", "..", "", "a\\b", "a\0"])
def test_an_object_whose_name_would_lead_elsewhere_is_refused(name):
    """Files are called by it, and an attack file may be a stranger's."""
    with pytest.raises(AttackFileError, match="expected a name of an object without slashes"):
        AttackedObject(name, np.ones((4, 3), np.float32), np.eye(4), 1.0, "")


def test_a_mesh_that_is_no_glb_is_refused():
    with pytest.raises(AttackFileError, match="expected the mesh of ball to be a GLB file"):
        AttackedObject("ball", np.ones((4, 3), np.float32), np.eye(4), 1.0, "", b"#!/bin/sh")
