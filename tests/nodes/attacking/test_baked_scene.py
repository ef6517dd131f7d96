"""A learned scene of the user's own is searched through its voxels if these look like it, and attacks are judged in the scene itself."""

import json

import numpy as np
import pytest
import torch

from advnerf_core.attack.artifact import load_attack
from advnerf_core.documents import read_json
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.scene.baked import BakedScene
from advnerf_core.scene.field import SceneField, SceneFieldConfig, save_scene
from advnerf_core.scene.render_field import FieldRenderer
from nodes.experiment.node.prepare import prepare
from nodes.experiment.node.search import run_attack
from nodes.experiment.steps import bake
from nodes.runtime.progress import ProgressDisplay
from tests.support.tiny_request import loaded, tiny_request

CORNERS = (-4.0, -4.0, 0.0), (4.0, 4.0, 2.5)


def walls_of_fog(folder, contraction):
    """A request in a scene whose walls are coloured fog, as an untrained field is."""
    file = tiny_request(folder)
    torch.manual_seed(1)
    grid = HashGridConfig(levels=2, features=2, log2_entries=10, coarsest=4, finest=8)
    field = SceneField(SceneFieldConfig(*CORNERS, grid=grid, hidden=16, contraction=contraction))
    occupied = np.ones((16, 16, 4), bool)
    occupied[1:-1, 1:-1] = False
    save_scene(folder / "scene.safetensors", field, occupied, {})
    return file


@pytest.mark.parametrize("contraction", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_search_uses_voxels_and_the_attack_is_judged_in_the_field(tmp_path, contraction):
    experiment = loaded(walls_of_fog(tmp_path, contraction))
    prepared = prepare(experiment)
    background = prepared.space.surrogate.background
    assert isinstance(background, BakedScene)
    pose, field = (
        bake.views_of(experiment)[:1],
        FieldRenderer.from_file(tmp_path / "scene.safetensors"),
    )
    of_field = field.render(pose, experiment.view.pinhole)[0]
    assert of_field.std() > 0.01  # there is something to see
    np.testing.assert_allclose(background.render(pose, experiment.view.pinhole)[0], of_field, atol=0.02)

    (file,) = run_attack(experiment, experiment.folder, ProgressDisplay())
    attack = load_attack(file)
    assert attack.field_total_cte_m == pytest.approx(attack.predicted_total_cte_m, rel=0.05)


def test_voxels_that_look_the_same_are_told_in_json(tmp_path, monkeypatch):
    monkeypatch.setattr(bake, "psnr", lambda *_: float("inf"))  # as of a scene without anything in sight
    experiment = loaded(walls_of_fog(tmp_path, contraction=False))
    prepare(experiment)
    text = (experiment.folder / "bake" / "baked.json").read_text()
    found = json.loads(text, parse_constant=lambda text: pytest.fail(f"{text} is no JSON"))
    assert (found["used"], found["psnr_to_scene_db"]) == (True, None)


def test_voxels_that_look_different_are_left_aside(tmp_path, monkeypatch):
    monkeypatch.setattr(bake, "_LEAST_ALIKE_DB", 200.0)
    experiment = loaded(walls_of_fog(tmp_path, contraction=False))
    assert isinstance(prepare(experiment).space.surrogate.background, FieldRenderer)
    found = read_json(experiment.folder / "bake" / "baked.json")
    assert not found["used"]
    assert found["psnr_to_scene_db"] < found["least_db"]
