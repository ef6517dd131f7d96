"""Policies that a user brings are attacked by an experiment: a file without a gradient and a module with one, none of them trained here."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
import yaml
from click.testing import Result
from typer.testing import CliRunner

from advnerf_core.documents import read_json
from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Array
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.frames import FrameStack
from advnerf_core.policies.load import load_adapted, load_any_policy
from advnerf_core.policies.onnx_policy import export_onnx
from advnerf_core.policies.tracker import TrackedTrajectory
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.lab import Lab
from nodes.cli.main import app
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run import plan
from nodes.experiment.run.plan import plan_cells, registered_under, statuses
from nodes.experiment.run.published import publish_build
from nodes.experiment.run.registering import register
from nodes.experiment.run.run import Options, run_cells
from nodes.experiment.run.whole import run_experiment
from nodes.experiment.run.worker import run_in_process
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import victim_sha256
from nodes.experiment.show.victims import look_at_given
from nodes.experiment.steps.deploy import DRIVES
from nodes.experiment.steps.keys import driven_folder
from nodes.experiment.steps.run import load_experiment
from tests.support import shut_world
from tests.support.commands import advnerf

TICKS = 3
MODULE = """
import torch
from advnerf_core import PolicyContract, PolicyView, adapt
from hardware.worlds.lab.config import CameraConfig

def factory():
    torch.manual_seed(0)
    layers = torch.nn.Conv2d(3, 8, 5, 8), torch.nn.ELU(), torch.nn.Flatten(), torch.nn.Linear(400, 1)
    view = PolicyView(CameraConfig(width=168, height=94).pinhole, crop_top_px=10, crop_height_px=60, width=80, height=40)
    normal = {"mean": (104.0, 117.0, 124.0), "std": (58.0, 57.0, 57.0), "value_max": 255.0}
    return adapt(torch.nn.Sequential(*layers).eval(), PolicyContract(view, colour_space="BGR", **normal, output_unit="deg", positive="right"))
"""
CAMERA = {"width": 168, "height": 94}
LAB = {"camera": CAMERA, "phone": {"width": 160, "height": 120}}
FILE: dict[str, Any] = {
    "name": "mine", "world": {"kind": "lab", **LAB}, "paths": ["track"], "held_cap_m": 1.5, "horizon": TICKS, "gate": None,
    "victims": {"mine": {"policy": "my.onnx"}, "module": {"policy": "my_driver:factory"}},
    "carrier": {"kind": "overlay", "resolution": 8}, "space": {"kind": "colours", "cells": 8}, "measure": {"starts": 1},
    "capture": {"photos": 9, "held_out": 3, "colour_pairs": 3}, "attack": {"evaluations": 2}, "over": {"method": ["none", "random"]},
    "scene": {"steps": 20, "log2_entries": 10, "finest": 64, "occupancy": 32, "interval_px": 32}, "settings": {"tiny": {}},
}  # fmt: skip
ONLY_THE_MODULE = ("victims={module: {policy: 'my_driver:factory'}}", "over.method=[none,random,gradient]")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder: a module with a policy, the same as an ONNX file, an experiment, and its run folder ``run``."""
    found = tmp_path_factory.mktemp("user")
    (found / "my_driver.py").write_text(MODULE)
    (found / "mine.experiment.yaml").write_text(yaml.safe_dump(FILE))
    with pytest.MonkeyPatch.context() as there:
        _enter(found, there)
        policy, _ = load_adapted("my_driver:factory")
        export_onnx(policy.network, policy.contract, found / "my.onnx")
        run_experiment(loaded(found))
    return found


@pytest.fixture(autouse=True)
def _in_the_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _enter(folder, monkeypatch)


def _enter(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """As a new process in a user's folder does: another folder's module of the same name is not there."""
    patch.chdir(folder)
    patch.syspath_prepend(str(folder))
    patch.delitem(sys.modules, "my_driver", raising=False)


def loaded(folder: Path, *overrides: str, run: str = "run") -> Experiment:
    return load_experiment(folder / "mine.experiment.yaml", "tiny", overrides, folder / run)


def test_both_are_attacked_and_nothing_was_trained(folder: Path) -> None:
    experiment = loaded(folder)
    assert [cell.name for cell in experiment.cells] == [
        "track_mine_none_0", "track_mine_random_0", "track_module_none_0", "track_module_random_0",
    ]  # fmt: skip
    assert not experiment.stage_folder("policy").exists()
    hashes = {
        victim: read_json(experiment.cell_result(Cell("track", victim, "random", 0)))["policy_sha256"]
        for victim in ("mine", "module")
    }
    assert hashes == {
        victim: load_any_policy(spec).sha256
        for victim, spec in (("mine", "my.onnx"), ("module", "my_driver:factory"))
    }
    page = (experiment.folder / "report" / "report.html").read_text()
    assert all(victim in page for victim in ("mine", "module"))


def test_the_file_drives_as_the_runtime_of_onnx_says(folder: Path) -> None:
    """A second implementation of camera, declaration and drive: OpenCV's own channel order, and ONNX Runtime asked directly."""
    experiment, session = loaded(folder), onnxruntime.InferenceSession(folder / "my.onnx")
    kept = read_json(driven_folder(experiment, Cell("track", "mine", "none", 0)) / DRIVES)
    with Lab(LabConfig.model_validate(LAB)) as world:
        world.reset(*map(float, experiment.measured_starts("track")[0]))
        for tick in range(TICKS):
            steering = steering_rad(session, experiment.view.image(world.observe(depth=False)[0]))
            assert kept["commands"][0][tick] == pytest.approx(steering, abs=1e-5)
            world.step(steering, experiment.car.speed_mps, experiment.config.dt_s)


class Plans(torch.nn.Module):
    """Two waypoints 0.4 m and 0.8 m ahead; the side is what the present image has that the one before had not."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        change = (
            images[:, 1].mean((1, 2, 3)) - images[:, 0].mean((1, 2, 3)) + 0.2 * images[:, 1].mean((1, 2, 3))
        )
        ahead = torch.tensor([0.4, 0.8])
        return torch.stack([ahead + 0.0 * change[:, None], change[:, None] * ahead], dim=2)


def test_a_policy_of_waypoints_and_two_images_is_attacked_and_drives_as_the_runtime_of_onnx_says(
    folder: Path,
) -> None:
    """The waypoints lie on a line, so that the point 0.5 m away and the wheel angle have a closed form."""
    tracked = TrackedTrajectory(times_s=(0.5, 1.0), lookahead_m=0.5, wheelbase_m=0.25)
    view = load_adapted("my_driver:factory")[0].contract.view
    contract = PolicyContract(view, frames=FrameStack(count=2, axis="time"), trajectory=tracked)
    export_onnx(Plans().eval(), contract, folder / "plans.onnx")
    change = "victims={plans: {policy: plans.onnx}}"
    run_experiment(loaded(folder, change))
    experiment, session = loaded(folder, change), onnxruntime.InferenceSession(folder / "plans.onnx")
    assert "total_cte_m" in read_json(experiment.cell_result(Cell("track", "plans", "random", 0)))["deployed"]
    kept = read_json(driven_folder(experiment, Cell("track", "plans", "none", 0)) / DRIVES)
    with Lab(LabConfig.model_validate(LAB)) as world:
        world.reset(*map(float, experiment.measured_starts("track")[0]))
        before = None
        for tick in range(TICKS):
            seen = (
                np.moveaxis(experiment.view.image(world.observe(depth=False)[0]), -1, 0).astype(np.float32)
                / 255
            )
            before = seen if before is None else before
            (points,) = session.run(None, {session.get_inputs()[0].name: np.stack([before, seen])[None]})
            before = seen
            side = np.sin(np.arctan2(points[0, 1, 1], points[0, 1, 0]))
            steering = float(np.arctan(0.25 * 2.0 * side / 0.5))
            assert abs(steering) > 1e-2
            assert kept["commands"][0][tick] == pytest.approx(steering, abs=1e-5)
            world.step(steering, experiment.car.speed_mps, experiment.config.dt_s)


def steering_rad(session: onnxruntime.InferenceSession, rgb: Array) -> float:
    bgr = (rgb[..., ::-1].astype(np.float32) - (104, 117, 124)) / (58, 57, 57)
    (answer,) = session.run(
        None, {session.get_inputs()[0].name: np.moveaxis(bgr, -1, 0)[None].astype(np.float32)}
    )
    return -float(np.deg2rad(answer.ravel()[0]))


def test_a_module_has_a_gradient_and_finished_cells_are_not_run_again(folder: Path) -> None:
    experiment = loaded(folder, *ONLY_THE_MODULE)
    ended = run_experiment(experiment)
    assert [end.name for end in ended] == ["track_module_gradient_0"]
    found = statuses(loaded(folder), loaded(folder).cells)
    assert {each.state for each in found} == {"done"}


def test_a_factory_is_found_beside_the_experiment_file(folder: Path, tmp_path: Path) -> None:
    """In a process of its own: this one has imported the module."""
    command = [
        sys.executable,
        "-m",
        "nodes.cli",
        "experiment",
        "status",
        str(folder / "mine.experiment.yaml"),
        "--setting",
        "tiny",
    ]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    done = subprocess.run(
        [*command, "--folder", str(folder / "run")],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert "4 done of 4 cells" in done.stdout, done.stderr


def test_a_registration_fixes_them_by_hash_before_anything_is_run(folder: Path, tmp_path: Path) -> None:
    experiment = load_experiment(folder / "mine.experiment.yaml", "tiny", (), tmp_path / "run")
    registered = register(experiment, experiment.cells, tmp_path / "published")
    assert registered.scenarios["track"].victims == {
        "policies": {
            "mine": load_any_policy("my.onnx").sha256,
            "module": load_any_policy("my_driver:factory").sha256,
        }
    }
    assert not experiment.stage_folder("capture").exists()


def test_a_policy_that_was_changed_after_its_registration_is_no_evidence(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is looked at again, and its cells alone are run under no registration."""
    monkeypatch.setattr(plan, "PUBLISHED", tmp_path / "published")
    file = folder / "mine.experiment.yaml"
    experiment = load_experiment(file, "tiny", (), tmp_path / "run")
    registered = register(experiment, experiment.cells, tmp_path / "published")
    text = (folder / "my_driver.py").read_text()
    try:
        (folder / "my_driver.py").write_text(text.replace("manual_seed(0)", "manual_seed(1)"))
        monkeypatch.delitem(sys.modules, "my_driver")
        changed = load_experiment(file, "tiny", (), tmp_path / "run")
        look_at_given(changed)
        said = plan.not_registered(changed, changed.cells)
        outside = {each.victim for each in changed.cells if not registered_under(registered, each, changed)}
    finally:
        (folder / "my_driver.py").write_text(text)
    assert (outside, said.startswith("2 cells are not run under the registration")) == ({"module"}, True)
    assert f"instead of '{registered.scenarios['track'].victims['policies']['module'][:39]}" in said


def _command(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.mark.parametrize(
    ("name", "spec", "kept"), [("mine", "my.onnx", True), ("module", "my_driver:factory", False)]
)
def test_a_published_set_is_driven_again_against_its_policy_file(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, spec: str, kept: bool
) -> None:
    """With nothing but the published files; a policy that is code is kept by its digest alone, which is said."""
    for file in ("my.onnx", "my_driver.py", "mine.experiment.yaml"):
        shutil.copy(folder / file, tmp_path / file)
    _enter(tmp_path, monkeypatch)
    (tmp_path / "docs" / "results").mkdir(parents=True)
    file, change = tmp_path / "mine.experiment.yaml", f"victims={{{name}: {{policy: '{spec}'}}}}"
    words = (file.name, "--setting", "tiny", "--folder", tmp_path / "run", "--set", change)
    experiment = load_experiment(file, "tiny", (change,), tmp_path / "run")
    assert _command("experiment", "register", *words).exit_code == 0
    run_experiment(experiment)
    published = _command("experiment", "publish", *words)
    said = "mine cannot be driven again: its scene or victim was not kept: module is code or a driver"
    assert (published.exit_code, said in published.output) == (0, not kept), published.output
    shutil.rmtree(tmp_path / "run")
    (tmp_path / "my.onnx").unlink()
    again = _command("verify", "mine", "--redrive", 2)
    assert again.output.count("at most 0.0000 m from the published poses, as published") == (2 if kept else 0)
    assert (again.exit_code, "nothing was driven again: mine" in again.output) == (
        (0, False) if kept else (1, True)
    )
    pruned = publish_build(experiment, (), tmp_path / "docs" / "results", prune=True)
    assert pruned.removed == ()


def test_their_camera_is_compared_with_a_world_that_must_be_open_to_be_described(
    folder: Path, tmp_path: Path
) -> None:
    change = f"world={{kind: '{shut_world.NAME}', camera: {CAMERA}}}"
    experiment = load_experiment(folder / "mine.experiment.yaml", "tiny", (change,), tmp_path / "run")
    assert not experiment.is_described
    run_experiment(experiment, until="capture")
    assert (
        load_experiment(folder / "mine.experiment.yaml", "tiny", (change,), tmp_path / "run").view.width == 80
    )


def test_variants_with_stages_of_their_own_are_run_from_nothing(folder: Path, tmp_path: Path) -> None:
    """In a world that must be open to be described, which each variant has yet to photograph."""
    changes = (
        f"world={{kind: '{shut_world.NAME}', camera: {CAMERA}}}",
        "over.method=[none]",
        "victims={module: {policy: 'my_driver:factory'}}",
        f"over.variant={{a: {{run_folder: {tmp_path / 'a'}}}, b: {{capture.seed: 1, run_folder: {tmp_path / 'b'}}}}}",
    )
    experiment = load_experiment(folder / "mine.experiment.yaml", "tiny", changes, tmp_path / "run")
    # It looks at the victims, and opens the world for that.
    register(experiment, experiment.cells, tmp_path / "published")
    again = load_experiment(folder / "mine.experiment.yaml", "tiny", changes, tmp_path / "run")
    ended = run_cells(again, again.cells, Options(here=True), lambda text: None)
    assert {each.name: each.how for each in ended} == {"a_module_none_0": "done", "b_module_none_0": "done"}
    for each in ended:  # a control searches nothing, but it drives
        result = read_json(tmp_path / "run" / "cells" / f"{each.name}.json")
        spent_s = float((tmp_path / "run" / "cells" / each.name / "seconds").read_text())
        assert 0.0 < result["seconds"] == round(spent_s, 1) <= each.seconds + 0.05


def test_stages_are_run_up_to_one_of_an_experiment_with_an_axis_once(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"

    def called(*words: str) -> object:
        changes = (f"run_folder={run}", "over.attack.evaluations=[3,5]")
        given = [word for each in changes for word in ("--set", each)]
        return advnerf(
            monkeypatch,
            "experiment",
            "run",
            folder / "mine.experiment.yaml",
            "--setting",
            "tiny",
            *given,
            *words,
        )

    assert called("--until", "capturing") != 0
    assert "expected one of the stages capture, " in capsys.readouterr().err
    assert not list(run.glob("*/stage.json"))
    assert called("--until", "capture") == 0
    assert capsys.readouterr().out.count("capture: started") == 1
    assert [each.parent.name for each in run.glob("*/stage.json")] == ["capture"]
    assert called("--page") != 0
    said = capsys.readouterr().err
    assert "got evaluations-3, evaluations-5; take them out of the section over" in said


def test_a_black_box_has_no_gradient(folder: Path) -> None:
    with pytest.raises(AdvnerfError, match=r"need no gradient against victim mine.*over\.method.*cem"):
        run_experiment(loaded(folder, "over.method=[none,random,gradient]"))


def test_a_black_box_is_not_registered_for_a_method_with_a_gradient(folder: Path, tmp_path: Path) -> None:
    experiment = loaded(folder, "over.method=[none,gradient]")
    with pytest.raises(AdvnerfError, match=r"mine\.experiment\.yaml: .*need no gradient against victim mine"):
        register(experiment, experiment.cells, tmp_path / "published")
    assert not (tmp_path / "published").exists()


def test_other_weights_that_a_factory_reads_are_another_policy(folder: Path, tmp_path: Path) -> None:
    """Its code is the same, so only loading it shows the weights."""
    (folder / "weights.txt").write_text("0")
    (folder / "reads_weights.py").write_text(
        MODULE.replace("manual_seed(0)", "manual_seed(int(open('weights.txt').read()))")
    )
    change = "victims={module: {policy: 'reads_weights:factory'}}"
    experiment = load_experiment(folder / "mine.experiment.yaml", "tiny", (change,), tmp_path / "run")
    hashes = []
    for seed in ("0", "0", "1"):
        (folder / "weights.txt").write_text(seed)
        look_at_given(experiment)
        hashes.append(victim_sha256(experiment, "module"))
    assert hashes[0] == hashes[1] != hashes[2]


UNSTEADY = {
    "drops": ("torch.nn.functional.dropout(images, 0.5, training=True)", "the output is random"),
    "mixes": ("images - images.mean(0, keepdim=True)", "an image steers differently in a batch than alone"),
}


@pytest.mark.parametrize("name", UNSTEADY)
def test_a_policy_that_answers_a_picture_in_different_ways_is_refused_before_anything_is_run(
    folder: Path, tmp_path: Path, name: str
) -> None:
    """Its prediction would be the noise of its drives."""
    done, sentence = UNSTEADY[name]
    first = f"class First(torch.nn.Module):\n    def forward(self, images):\n        return {done}\n"
    text = MODULE.replace("def factory", f"{first}\ndef factory").replace(
        "Sequential(*", "Sequential(First(), *"
    )
    (folder / f"unsteady_{name}.py").write_text(text)
    change = f"victims={{module: {{policy: 'unsteady_{name}:factory'}}}}"
    try:
        experiment = load_experiment(folder / "mine.experiment.yaml", "tiny", (change,), tmp_path / "run")
        with pytest.raises(AdvnerfError, match=f"unsteady_{name}:factory: expected a policy.*{sentence}"):
            run_experiment(experiment)
    finally:
        (folder / f"unsteady_{name}.py").unlink()
    assert not experiment.stage_folder("capture").exists()
    assert not (experiment.folder / "victims.json").exists()


@pytest.mark.parametrize("changed_first", [False, True])
def test_another_policy_under_the_same_name_is_another_cell(
    folder: Path, tmp_path: Path, changed_first: bool
) -> None:
    """States of a run folder say so before the policy is ever loaded, of its cells alone, and running looks at it again."""
    shutil.copytree(folder / "run", tmp_path / "run")
    victims = {"mine": "my.onnx", "module": "my_driver:factory"}
    named = [f"{name}: {{policy: '{victims[name]}'}}" for name in sorted(victims, reverse=changed_first)]
    change = (f"victims={{{', '.join(named)}}}",)
    text = (folder / "my_driver.py").read_text()
    try:
        (folder / "my_driver.py").write_text(text.replace("manual_seed(0)", "manual_seed(1)"))
        changed = load_experiment(folder / "mine.experiment.yaml", "tiny", change, tmp_path / "run")
        states = {each.cell.victim: (each.state, each.text) for each in statuses(changed, changed.cells)}
    finally:
        (folder / "my_driver.py").write_text(text)
    again = "its victim changed since it was last looked at; advnerf experiment run looks again"
    assert states == {"mine": ("done", ""), "module": ("changed", again)}


def test_a_module_that_is_there_for_a_moment_fails_no_cell(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "run", tmp_path / "run")
    changes = (*ONLY_THE_MODULE, "over.seed=[0,1]")
    experiment = load_experiment(folder / "mine.experiment.yaml", "tiny", changes, tmp_path / "run")
    look_at_given(experiment)
    cell = Cell("track", "module", "random", 1)
    (job,) = plan_cells(experiment, [cell])
    (folder / "beside.py").write_text("")
    try:
        ended = run_in_process(job)
    finally:
        (folder / "beside.py").unlink()
    assert (ended.how, "my_driver:factory as it was" in ended.text) == ("lost", True), ended.text
    assert "all Python files of its package, or else of its folder, count" in ended.text
    assert [each.state for each in statuses(experiment, [cell])] == ["missing"]
    assert run_in_process(job).how == "done"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("victims={mine: {policy: no.onnx}}", r"victims\.mine\.policy: expected a policy file.*no\.onnx, which is not there"),
        ("victims={mine: {policy: my_driver.py}}", r"my_driver\.py; name a function in it"),
        ("victims={mine: {}}", r"victims\.mine: expected \{policy: FILE\} .* or \{train: \{\}\}"),
        ("victims={mine: {policy: my.onnx, train: {}}}", r"unknown key victims\.mine\.train; valid keys here: policy"),
        ("victims={retrained: {policy: my.onnx}}", r"other names than retrained"),
        ("victims={a: {train: {}}, b: {train: {}}}", r"a, b, of which two would be the same policy"),
        ("victims={my_own: {policy: my.onnx}}", r"should match pattern"),
    ],
)  # fmt: skip
def test_victims_that_there_cannot_be(folder: Path, change: str, message: str) -> None:
    with pytest.raises(AdvnerfError, match=message):
        loaded(folder, change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("view.crop_top_px=10", r"no section view with victims\.mine"),
        (
            "world.camera.width=320",
            r"victims\.mine: expected a policy that was trained for the driving camera",
        ),
    ],
)
def test_a_policy_says_itself_what_it_sees(folder: Path, change: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(AdvnerfError, match=message):
        run_experiment(load_experiment(folder / "mine.experiment.yaml", "tiny", (change,), tmp_path / "run"))


@pytest.mark.slow
def test_a_driver_behind_a_socket_is_attacked(folder: Path, tmp_path: Path) -> None:
    """It is asked over gRPC, as alpasim and CARLA users do, in the learned scene and where it is deployed."""
    pytest.importorskip("carla_driver_interface")
    from carla_driver_interface.policies.constant_speed import ConstantSpeedPolicy
    from carla_driver_interface.server import serving

    with serving(ConstantSpeedPolicy(), port=0, host="127.0.0.1") as port:
        victims = f"victims={{theirs: {{policy: 'grpc://127.0.0.1:{port}'}}}}"
        # No two of its drives differ, so the face itself has to be seen: a scene learned any less is fog in front of it.
        changes = (victims, "capture.photos=60", "scene.steps=120")
        experiment = load_experiment(folder / "mine.experiment.yaml", "tiny", changes, tmp_path / "run")
        run_experiment(experiment)
        with pytest.raises(AdvnerfError, match=r"need no gradient against victim theirs"):
            run_experiment(
                load_experiment(
                    folder / "mine.experiment.yaml",
                    "tiny",
                    (*changes, "over.method=[none,gradient]"),
                    tmp_path / "run",
                )
            )
    # It plans straight ahead whatever it sees.
    kept = read_json(driven_folder(experiment, Cell("track", "theirs", "none", 0)) / DRIVES)
    assert kept["commands"] == [[0.0] * TICKS]
    found = read_json(experiment.cell_result(Cell("track", "theirs", "random", 0)))
    assert "constant_speed" in read_json(experiment.folder / "victims.json")["theirs"]["not_fixed"]
    assert found["deployed"]["total_cte_m"] == found["deployed"]["none_total_cte_m"]


@pytest.mark.slow
def test_live_nodes_drive_a_users_file(folder: Path, tmp_path: Path) -> None:
    """The policy node loads it by the name that the experiment gives, and a victim without a gradient has a page too."""
    launch = Path(__file__).parents[3] / "launch" / "green_screen.launch.yaml"
    changes = (
        "victims={mine: {policy: my.onnx}}",
        "horizon=20",
        "deploy={through: nodes, starts: 1, launch_file: " + str(launch) + "}",
    )
    experiment = load_experiment(folder / "mine.experiment.yaml", "tiny", changes, tmp_path / "run")
    run_experiment(experiment)
    found = read_json(experiment.cell_result(Cell("track", "mine", "random", 0)))
    assert len(found["deployed"]["total_cte_m"]) == 1, found["not_driven_live"]
    page = (experiment.folder / "report" / "report.html").read_text()
    assert f"{found['deployed']['total_cte_m'][0] / 20:.3f}" in page  # the mean |CTE| of the live drive


def test_the_gate_judges_the_main_victim_and_refuses_a_name_that_is_none(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def gate(*words: str) -> tuple[object, str, str]:
        asked = ["scene", "gate", folder / "mine.experiment.yaml", "--setting", "tiny", "--folder"]
        code = advnerf(monkeypatch, *asked, folder / "run", "--json", *words)
        return code, *capsys.readouterr()

    code, judged, _ = gate()
    assert code in (0, 1)
    assert gate("--victim", "mine", "--path", "track")[1] == judged != ""
    for wrong, told in (
        (("--victim", "nosuch"), "--victim: expected a victim of mine, module; got 'nosuch'"),
        (("--victim", "hardened"), "--victim: expected a victim of mine, module; got 'hardened'"),
        (("--path", "trak"), "--path: expected a path of track; got 'trak' (did you mean track?)"),
    ):
        code, _, said = gate(*wrong)
        assert code == 2
        assert len(said.strip().splitlines()) == 1
        assert told in said
