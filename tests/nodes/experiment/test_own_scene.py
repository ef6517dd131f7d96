"""An experiment in a learned scene of a user's own: it is only baked, and its methods are compared like those of any other."""

import shutil

import numpy as np
import pytest
import torch
import yaml

from advnerf_core.attack.artifact import load_attack
from advnerf_core.documents import read_json
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import save_policy
from advnerf_core.policies.view import PolicyView
from calibration.schema import CameraCalibration, load_calibration
from hardware.worlds.world import WorldError
from nodes.experiment.engine.run_folder import ATTACK, FROZEN, SEARCHED
from nodes.experiment.node.search import run_attack
from nodes.experiment.run.cells import search_cell
from nodes.experiment.run.whole import run_experiment
from nodes.experiment.steps import bake
from nodes.experiment.steps.keys import search_key, settings_hash
from nodes.experiment.steps.pipeline import stages_of
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.progress import ProgressDisplay
from tests.support.tiny_request import CALIBRATION, loaded, tiny_request

CHANGES = ["over.method=[none, random, gradient]", "measure.starts=1", "attack.evaluations=2"]


def test_methods_are_compared_in_it_and_find_what_a_request_finds(tmp_path):
    file = tiny_request(tmp_path, evaluations=2)
    experiment = load_experiment(file, None, CHANGES, tmp_path / "run")
    run_experiment(experiment)
    assert [stage.name for stage in stages_of(experiment)] == ["bake"]
    results = {cell.method: read_json(experiment.cell_result(cell)) for cell in experiment.cells}
    assert {method: result["attack_id"] is None for method, result in results.items()} == {
        "none": True,
        "random": False,
        "gradient": False,
    }
    assert (experiment.folder / "report" / "report.html").stat().st_size > 1000
    (asked,) = run_attack(loaded(file), tmp_path / "asked", ProgressDisplay())
    gradient = next(cell for cell in experiment.cells if cell.method == "gradient")
    found = load_attack(experiment.cell_folder(gradient) / "attack.safetensors")
    assert found.predicted_total_cte_m == load_attack(asked).predicted_total_cte_m
    assert found.face.subject == load_attack(asked).face.subject == "board"


def test_cells_depend_on_what_files_hold_and_not_on_where_they_lie(tmp_path):
    from nodes.experiment.show.victims import look_at_given

    def keys(folder, *changes):
        experiment = load_experiment(
            folder / "tiny.experiment.yaml", None, [*CHANGES, *changes], folder / "run"
        )
        look_at_given(experiment)
        return [settings_hash(experiment, cell) for cell in experiment.cells]

    tiny_request(tmp_path / "a")
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    before = keys(tmp_path / "a")
    assert keys(tmp_path / "b") == before
    assert not set(keys(tmp_path / "b", "objects=[{name: a, kind: panel, x_m: 1, y_m: -1}]")) & set(before)
    assert not set(keys(tmp_path / "b", "world.speed_mps=0.7")) & set(before)


def test_searches_and_cells_of_another_baking_are_not_gone_on_with(tmp_path, monkeypatch):
    from nodes.experiment.show.victims import look_at_given

    experiment = load_experiment(tiny_request(tmp_path), None, CHANGES, tmp_path / "run")
    look_at_given(experiment)
    found = [cell for cell in experiment.cells if cell.searched]
    before = [(settings_hash(experiment, cell), search_key(experiment, cell)) for cell in found]
    monkeypatch.setattr(bake, "OWN_VERSION", bake.OWN_VERSION - 1)
    after = [(settings_hash(experiment, cell), search_key(experiment, cell)) for cell in found]
    assert len(found) == 2
    for (cell, search), (other_cell, other_search) in zip(before, after, strict=True):
        assert (cell != other_cell, search != other_search) == (True, True)


def test_a_start_outside_the_learned_box_is_refused(tmp_path):
    file = tiny_request(tmp_path)
    with pytest.raises(WorldError, match=r"expected drives that start in the learned box, .* got x = 70 m"):
        load_experiment(file, None, ["world.start=[70, 0, 0]"], tmp_path / "run")


def test_a_teacher_may_be_firmer_than_its_file_says_and_no_softer(tmp_path):
    """As for the steering that an audit exports, in a world whose lane the usual teacher was not made for."""
    usual, firm = (
        load_experiment(
            tiny_request(tmp_path), None, [*CHANGES, f"policy.stiffness_1pm={stiffness}"], tmp_path / "run"
        )
        for stiffness in (0.2, 0.5)
    )
    states = np.add(usual.paths["track"].pose_at(np.linspace(0.1, 2.0, 5)), [0.0, 0.2, 0.1])
    soft, asked, wanted = (
        teacher.steer_states(states)
        for teacher in (usual.expert("track"), usual.expert("track", 0.5), firm.expert("track"))
    )
    np.testing.assert_array_equal(asked, wanted)
    assert np.abs(asked - soft).max() > 0.02
    np.testing.assert_array_equal(usual.expert("track", 0.1).steer_states(states), soft)


def test_a_driving_camera_outside_the_learned_box_is_refused(tmp_path):
    file = tiny_request(tmp_path)
    camera = yaml.safe_load((CALIBRATION / "camera.yaml").read_text())
    for height_m in (-0.4, 3.0):
        camera["T_car_from_camera"][2][3] = height_m
        (tmp_path / "camera.yaml").write_text(yaml.safe_dump(camera))
        with pytest.raises(
            WorldError, match=rf"expected a driving camera in the learned box, .* got one {height_m:g} m"
        ):
            load_experiment(file, None, [f"world.camera={tmp_path / 'camera.yaml'}"], tmp_path / "run")


def test_a_search_of_another_policy_in_the_same_folder_is_made_anew(tmp_path):
    """An audit keeps its folder between runs, in which the policy's file may have been replaced."""
    file = tiny_request(tmp_path, evaluations=2)
    folder, found = tmp_path / "search", []
    for seed in (0, 1, 1):
        torch.manual_seed(seed)
        camera = load_calibration(CameraCalibration, CALIBRATION / "camera.yaml")
        save_policy(tmp_path / "policy.safetensors", PilotNet().eval(), PolicyView(camera.pinhole), {})
        experiment = load_experiment(file, None, CHANGES, tmp_path / "run")
        run_experiment(experiment, until="bake")
        cell = next(each for each in experiment.cells if each.method == "gradient")
        before = (folder / ATTACK).stat().st_mtime_ns if found else 0
        search_cell(experiment, cell, folder, lambda *told: None)
        frozen = read_json(folder / FROZEN)
        found.append(
            (
                frozen["policy"],
                read_json(folder / SEARCHED)["states"],
                (folder / ATTACK).stat().st_mtime_ns != before,
            )
        )
    assert found[0][0] != found[1][0] == found[2][0]
    assert found[0][1] != found[1][1] == found[2][1]
    assert [made for _, _, made in found] == [True, True, False]
