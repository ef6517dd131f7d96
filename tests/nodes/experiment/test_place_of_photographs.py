"""A user's own policy is attacked in a place of which there are photographs and nothing else."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from advnerf_core.data.transforms import load_transforms
from advnerf_core.documents import read_json
from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import make_transform, rotation_z
from advnerf_core.scene.baked import BakedScene
from advnerf_core.scene.render_field import FieldRenderer
from hardware.worlds.lab.config import CameraConfig, LabConfig
from hardware.worlds.lab.lab import Lab
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.whole import run_experiment
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.learned_scene import load_background
from nodes.experiment.steps.keys import settings_hash
from nodes.experiment.steps.run import load_experiment, make_ready
from tests.support.lab_photographs import photograph

PHOTOGRAPHS, TICKS = 24, 3
MODULE = """
import torch
from advnerf_core import PolicyContract, PolicyView, adapt
from hardware.worlds.lab.config import CameraConfig

def factory():
    torch.manual_seed(0)
    layers = torch.nn.Conv2d(3, 8, 5, 8), torch.nn.ELU(), torch.nn.Flatten(), torch.nn.Linear(400, 1)
    view = PolicyView(CameraConfig(width=168, height=94).pinhole, crop_top_px=10, crop_height_px=60, width=80, height=40)
    return adapt(torch.nn.Sequential(*layers).eval(), PolicyContract(view, output_unit="deg"))
"""
T_IMAGES_FROM_LAB = make_transform(rotation_z(0.5), [3.0, -2.0, 1.2])
FILE: dict[str, Any] = {
    "name": "hall", "paths": ["track"], "held_cap_m": 1.5, "horizon": TICKS, "gate": None,
    "world": {
        "kind": "photographs", "images": "my_photos", "closed": True, "off_track_m": 0.25,
        "car": {"speed_mps": 0.8, "wheelbase_m": 0.325, "max_steering_rad": 0.35}, "camera": {"x_m": 0.3, "z_m": 0.2},
    },
    "victims": {"mine": {"policy": "hall_driver:factory"}},
    "objects": [{"name": "board", "kind": "panel", "x_m": 6.43, "y_m": -2.86, "yaw_rad": 3.64, "scale": 0.3}],
    "space": {"kind": "colours"}, "deploy": {"through": "nothing"}, "capture": {"held_out": 4}, "measure": {"starts": 1},
    "scene": {"steps": 12, "log2_entries": 10, "levels": 3, "finest": 16, "occupancy": 16, "interval_px": 64},
    "attack": {"evaluations": 2}, "over": {"method": ["none", "random", "gradient"]}, "object": {"panel_resolution": 4},
    "settings": {"tiny": {}},
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder: photographs that a car took on a lap of the lab, in a frame of their own, and a module with a policy."""
    found = tmp_path_factory.mktemp("hall")
    with Lab(LabConfig(camera=CameraConfig(width=168, height=94))) as lab:
        path = lab.describe().paths["track"]
        states = [path.pose_at(path.length_m * index / PHOTOGRAPHS) for index in range(PHOTOGRAPHS)]
        photograph(lab, states, found / "my_photos", T_IMAGES_FROM_LAB)
    (found / "hall_driver.py").write_text(MODULE)
    (found / "hall.experiment.yaml").write_text(yaml.safe_dump(FILE))
    return found


@pytest.fixture(autouse=True)
def _in_the_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))


def loaded(folder: Path, *overrides: str) -> Experiment:
    return load_experiment(folder / "hall.experiment.yaml", "tiny", overrides, folder / "run")


def test_it_is_attacked_in_what_is_learned_and_held_out_views_are_not_learned_from(folder: Path) -> None:
    experiment = loaded(folder)
    run_experiment(experiment)
    learned, held_out = (
        load_transforms(experiment.stage_folder("capture") / name) for name in ("photos", "held_out")
    )
    assert (len(learned.frames), len(held_out.frames)) == (PHOTOGRAPHS - 4, 4)
    ours = {tuple(np.round(each.T_world_from_camera[:3, 3], 6)) for each in learned.frames}
    assert ours.isdisjoint(tuple(np.round(each.T_world_from_camera[:3, 3], 6)) for each in held_out.frames)
    results = {cell.method: read_json(experiment.cell_result(cell)) for cell in experiment.cells}
    assert list(results) == ["none", "random", "gradient"]
    for method, result in results.items():
        assert "deployed" not in result
        assert (result["attack_id"] is None) == (method == "none")
    # The car starts on the path that the photographs show, and the policy hardly steers in three ticks.
    assert results["none"]["surrogate"]["total_cte_m"][0] < TICKS * 0.25
    page = (experiment.folder / "report" / "report.html").read_text()
    assert "nothing was driven in the place itself" in page
    assert ">deployed<" not in page, "no rows of drives that there cannot be"
    assert ">over the plain object [m]<" in page
    assert ">over no object [m]<" not in page, "no column of a control that nobody drove"
    assert "<h1>In the learned scene " in page
    assert "<video autoplay" in page, "the learned scene is filmed where nothing else is"


def test_it_is_baked_if_asked_and_only_what_depends_on_that_is_made_again(folder: Path) -> None:
    """It reaches outside its box, as the photographs do."""
    plain, baked = loaded(folder), loaded(folder, "scene.bake_unbounded=true")
    cell = Cell("track", "mine", "gradient", 0)
    make_ready(plain, until="bake")
    before = settings_hash(plain, cell)
    assert isinstance(load_background(plain), FieldRenderer)
    scene = (plain.stage_folder("scene") / "stage.json").read_bytes()
    make_ready(baked, until="bake")
    assert isinstance(load_background(baked), BakedScene)
    assert (baked.stage_folder("scene") / "stage.json").read_bytes() == scene
    assert settings_hash(baked, cell) != before


def test_the_same_photographs_elsewhere_are_the_same_place(folder: Path, tmp_path: Path) -> None:
    for name in ("my_photos", "hall.experiment.yaml", "hall_driver.py"):
        source = folder / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, tmp_path / name)
    assert loaded(tmp_path).world_settings == loaded(folder).world_settings


def test_without_an_object_there_is_nothing_to_search(folder: Path) -> None:
    with pytest.raises(
        AdvnerfError, match="expected objects, whose colours or places are searched, got none"
    ):
        settings_hash(loaded(folder, "objects=[]"), Cell("track", "mine", "gradient", 0))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("deploy.through=world", "expected deploy.through nothing"),
        ("victims={}", "expected victims that exist"),
        ("objects=[{name: a, kind: panel, stands: {}}]", "expected objects whose places are given"),
        ("space={kind: mesh_shape}", "an object with a mesh|objects with a mesh|expected space.kind colours"),
        ("carrier={kind: native}", r"--set carrier=.*into its own scene \(add_panel\)"),
        ("world.images=nowhere", r"world\.images|images: expected a file or folder"),
        ("world.camera.height_m=0.3", r"unknown key .*camera\.height_m"),
    ],
)
def test_what_such_a_place_cannot_do_is_said_before_anything_is_made(
    folder: Path, change: str, expected: str
) -> None:
    with pytest.raises(AdvnerfError, match=expected):
        loaded(folder, change)
