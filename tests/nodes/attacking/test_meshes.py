"""Requests for attacks on meshes: run, resumed to the same bytes, exported; and what they refuse."""

import json

import numpy as np
import pytest
import torch

from advnerf_core.attack.artifact import load_attack
from advnerf_core.data.image_files import write_image
from advnerf_core.objects.mesh.engine import MeshEngineError, engine
from nodes.experiment.node.check import check
from nodes.experiment.node.prepare import prepare
from nodes.experiment.node.printed import export_attack
from nodes.experiment.node.search import run_attack
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay
from tests.support.commands import advnerf
from tests.support.glb import mesh_from_glb
from tests.support.strangers import write_spiral
from tests.support.tiny_request import StoppedError, loaded, stop_at_one, tiny_request, with_objects

HYDRANT = "{name: hydrant, kind: hydrant, x_m: 1.2, y_m: -1.7, mesh: {texels: 8, height_m: 0.6}}"
BALL = "{name: ball, kind: ball, x_m: 0.9, y_m: -1.9, mesh: {texels: 8, height_m: 0.5}}"
SHAPE = "space: {kind: mesh_shape, bound_m: 0.1, samples: 1}"


@pytest.fixture(scope="module", autouse=True)
def mitsuba_works():
    try:
        engine()
    except MeshEngineError as error:
        pytest.skip(str(error))


def asked(folder, *objects, rest=""):
    return with_objects(tiny_request(folder), *objects, rest=rest)


@pytest.mark.slow
def test_textures_of_a_mesh_are_searched_resumed_and_exported(tmp_path):
    face = "{name: face, kind: panel, x_m: 1.4, y_m: -1.5, yaw_rad: 3.1, face: {size_m: 0.8, resolution: 8}}"
    request = loaded(asked(tmp_path, HYDRANT, face))
    (whole,) = run_attack(request, tmp_path / "whole", ProgressDisplay())
    with pytest.raises(StoppedError):
        run_attack(request, tmp_path / "stopped", ProgressDisplay(), stop_at_one)
    (resumed,) = run_attack(request, tmp_path / "stopped", ProgressDisplay())
    assert resumed.read_bytes() == whole.read_bytes()
    attack = load_attack(whole)
    assert [each.name for each in attack.objects] == ["hydrant", "face"]
    (glb,) = (each for each in export_attack(attack, tmp_path, "found") if each.suffix == ".glb")
    assert glb.name == "found.0_hydrant.glb"
    found = 1.0 / (1.0 + np.exp(-attack.objects[0].theta))
    used = prepare(request).space.surrogate.objects[0].mesh.charts >= 0
    assert np.abs(mesh_from_glb(glb.read_bytes()).texture - found)[used].max() < 0.6 / 255


def test_shapes_are_searched_only_by_methods_that_read_their_scale(tmp_path):
    write_spiral(tmp_path)
    file = asked(tmp_path, BALL, rest=SHAPE)
    for method, name in (("cem", "cem"), ("spiral.py:Spiral", "Spiral")):
        says = f"expected a method that searches shapes, such as random or gradient, got {name}"
        with pytest.raises(ConfigError, match=says):
            run_attack(loaded(file, [f"over.method=[{method}]"]), tmp_path / "out", ProgressDisplay())
    assert not (tmp_path / "out").exists()


def test_the_gradient_of_textures_passes_the_check(tmp_path):
    found = check(loaded(asked(tmp_path, HYDRANT)), 3, False, lambda fraction, text="": None)
    assert found.frozen_error < 1e-3
    assert found.gradient_norm > 0.0


@pytest.mark.parametrize("method", ["gradient", "random"])
def test_shapes_are_searched_resumed_and_exported(tmp_path, method):
    file = asked(tmp_path, BALL, rest=SHAPE)
    request = loaded(file, [f"over.method=[{method}]"])
    (whole,) = run_attack(request, tmp_path / "whole", ProgressDisplay())
    with pytest.raises(StoppedError):
        run_attack(request, tmp_path / "stopped", ProgressDisplay(), stop_at_one)
    (resumed,) = run_attack(request, tmp_path / "stopped", ProgressDisplay())
    assert resumed.read_bytes() == whole.read_bytes()
    attack = load_attack(whole)
    assert attack.extra["searched_space"]["bound_m"] == 0.1
    assert attack.objects[0].theta.shape == (642, 3)
    prepared = prepare(request)
    theta = prepared.problem.sensor.initial_theta(torch.Generator().manual_seed(5))
    (shape,) = prepared.space.sensor.shaped(theta)
    assert np.abs(shape.mesh.vertices - prepared.space.surrogate.objects[0].mesh.vertices).max() < 1e-3
    assert attack.space == "mesh_shape"
    (glb,) = export_attack(attack, tmp_path, "found")
    assert len(mesh_from_glb(glb.read_bytes()).vertices) == 642
    assert len(json.loads((tmp_path / "whole" / "seed_0.json").read_text())["loss_m"]) == 3
    if method == "gradient":
        with pytest.raises(ConfigError, match="Monte Carlo"):
            check(request, 3, False, lambda fraction, text="": None)


@pytest.mark.parametrize(
    ("objects", "rest", "what"),
    [
        (["{name: a, kind: hydrant, x_m: 1, y_m: 1}"], "", "or objects with the section mesh"),
        (["{name: a, kind: panel, x_m: 1, y_m: 1, mesh: {}}"], "", "expected no mesh of panel"),
        (["{name: a, kind: panel, x_m: 1, y_m: 1}"], SHAPE, "expected objects with a mesh"),
        ([BALL], "space: {kind: mesh_shape, bound_m: 0}", "bound_m"),
        ([BALL], "space: {kind: places}", "made of voxels"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, objects, rest, what):
    with pytest.raises(ConfigError, match=what):
        loaded(asked(tmp_path, *objects, rest=rest))


def test_a_file_that_is_no_mesh_is_one_line_and_exit_code_2(tmp_path, capsys, monkeypatch):
    (tmp_path / "broken.glb").write_bytes(b"nothing")
    file = asked(tmp_path, "{name: a, kind: broken.glb, x_m: 1, y_m: 1, mesh: {}}")
    assert advnerf(monkeypatch, "attack", "run", file, "-o", tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert "broken.glb" in error
    assert "Traceback" not in error


def test_a_search_is_of_the_mesh_and_of_all_files_that_it_names(tmp_path):
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    )
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd t.png\n")
    placed = "{name: a, kind: a.obj, x_m: 1, y_m: 1, mesh: {texels: 8, height_m: 0.5}}"
    request, found = loaded(asked(tmp_path, placed)), []
    for colour in (10, 20, 10):
        write_image(tmp_path / "t.png", np.full((4, 4, 3), colour, np.uint8))
        found.append(prepare(request).settings_hash)
    assert found[0] == found[2] != found[1]
