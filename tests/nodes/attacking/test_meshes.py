"""Requests for attacks on meshes: run, resumed to the same bytes, exported; and what they refuse."""

import json
import sys

import numpy as np
import pytest
import torch

from advnerf_core.attack.artifact import load_attack
from advnerf_core.data.image_files import write_image
from advnerf_core.objects.mesh.engine import MeshEngineError, engine
from advnerf_core.objects.mesh.glb import read_glb
from nodes.cli import main as cli
from nodes.experiment.node.check import check
from nodes.experiment.node.prepare import prepare
from nodes.experiment.node.printed import export_attack
from nodes.experiment.node.request import load_request
from nodes.experiment.node.search import run_attack
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay
from tests.support.strangers import write_spiral
from tests.support.tiny_request import tiny_request

HYDRANT = "{kind: mesh, x_m: 1.2, y_m: -1.7, z_m: 0.0, mesh: {generate: hydrant, texels: 8, height_m: 0.6}}"
BALL = "{kind: mesh, x_m: 0.9, y_m: -1.9, z_m: 0.0, mesh: {generate: ball, texels: 8, height_m: 0.5}}"


@pytest.fixture(scope="module", autouse=True)
def mitsuba_works():
    try:
        engine()
    except MeshEngineError as error:
        pytest.skip(str(error))


class StoppedError(Exception):
    pass


def stop_at_one(evaluation):
    if evaluation.iteration == 1:
        raise StoppedError


def asked(folder, *objects, rest=""):
    file = tiny_request(folder)
    lines = file.read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("objects:"))
    lines[first : first + 2] = ["objects:", *(f"  - {text}" for text in objects), rest]
    file.write_text("\n".join(lines) + "\n")
    return file


@pytest.mark.slow
def test_textures_of_a_mesh_are_searched_resumed_and_exported(tmp_path):
    face = "{x_m: 1.4, y_m: -1.5, z_m: 0.4, yaw_rad: 3.1, resolution: 8}"
    request = load_request(asked(tmp_path, HYDRANT, face))
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
    used = prepare(request).surrogate.objects[0].mesh.charts >= 0
    assert np.abs(read_glb(glb).texture - found)[used].max() < 0.6 / 255


def test_shapes_are_searched_only_by_methods_that_read_their_scale(tmp_path):
    write_spiral(tmp_path)
    file = asked(tmp_path, BALL, rest="shape: {bound_m: 0.1, samples: 1}")
    with pytest.raises(ConfigError, match="shape: expected method random or gradient"):
        load_request(file, ["search.method=cem"])
    with pytest.raises(
        ConfigError, match="expected a method that searches shapes, such as random or gradient, got Spiral"
    ):
        run_attack(
            load_request(file, ["search.method=spiral.py:Spiral"]), tmp_path / "out", ProgressDisplay()
        )
    assert not (tmp_path / "out").exists()


def test_the_gradient_of_textures_passes_the_check(tmp_path):
    found = check(load_request(asked(tmp_path, HYDRANT)), 3, False, lambda fraction, text="": None)
    assert found.frozen_error < 1e-3
    assert found.gradient_norm > 0.0


@pytest.mark.parametrize("method", ["gradient", "random"])
def test_shapes_are_searched_resumed_and_exported(tmp_path, method):
    file = asked(tmp_path, BALL, rest="shape: {bound_m: 0.1, samples: 1}")
    request = load_request(file, [f"search.method={method}"])
    (whole,) = run_attack(request, tmp_path / "whole", ProgressDisplay())
    with pytest.raises(StoppedError):
        run_attack(request, tmp_path / "stopped", ProgressDisplay(), stop_at_one)
    (resumed,) = run_attack(request, tmp_path / "stopped", ProgressDisplay())
    assert resumed.read_bytes() == whole.read_bytes()
    attack = load_attack(whole)
    assert attack.extra["shape"]["bound_m"] == 0.1
    assert attack.objects[0].theta.shape == (642, 3)
    prepared = prepare(request)
    (shape,) = prepared.meshes(prepared.problem.sensor.initial_theta(torch.Generator().manual_seed(5)))
    assert np.abs(shape.vertices - prepared.surrogate.objects[0].mesh.vertices).max() < 1e-3
    assert attack.space == "mesh_shape"
    (glb,) = export_attack(attack, tmp_path, "found")
    assert len(read_glb(glb).vertices) == 642
    assert len(json.loads((tmp_path / "whole" / "seed_0.json").read_text())["loss_m"]) == 3
    if method == "gradient":
        with pytest.raises(ConfigError, match="Monte Carlo"):
            check(request, 3, False, lambda fraction, text="": None)


@pytest.mark.parametrize(
    ("objects", "rest", "what"),
    [
        (["{kind: mesh, x_m: 1, y_m: 1, z_m: 0}"], "", "key mesh exactly with kind 'mesh'"),
        (["{kind: mesh, x_m: 1, y_m: 1, z_m: 0, mesh: {}}"], "", "exactly one of file and generate"),
        (["{x_m: 1, y_m: 1, z_m: 0}"], "shape: {}", "objects of kind 'mesh' only"),
        ([BALL], "shape: {bound_m: 0}", "bound_m"),
        ([BALL], "poses: {bounds: [{x_m: [0, 1]}]}", "made of voxels"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, objects, rest, what):
    with pytest.raises(ConfigError, match=what):
        load_request(asked(tmp_path, *objects, rest=rest))


def test_a_file_that_is_no_mesh_is_one_line_and_exit_code_2(tmp_path, capsys, monkeypatch):
    (tmp_path / "broken.glb").write_bytes(b"nothing")
    file = asked(tmp_path, "{kind: mesh, x_m: 1, y_m: 1, z_m: 0, mesh: {file: broken.glb}}")
    monkeypatch.setattr(sys, "argv", ["advnerf", "attack", "run", str(file), "-o", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert "broken.glb" in error
    assert "Traceback" not in error


def test_a_search_is_of_the_mesh_and_of_all_files_that_it_names(tmp_path):
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    )
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd t.png\n")
    placed = "{kind: mesh, x_m: 1, y_m: 1, z_m: 0, mesh: {file: a.obj, texels: 8, height_m: 0.5}}"
    request, found = load_request(asked(tmp_path, placed)), []
    for colour in (10, 20, 10):
        write_image(tmp_path / "t.png", np.full((4, 4, 3), colour, np.uint8))
        found.append(prepare(request).settings_hash)
    assert found[0] == found[2] != found[1]
