"""Wrong options of the command are no verdict: its exit codes below 64 are."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from advnerf_core.data.posed_images import write_posed_images
from advnerf_core.geometry import Pinhole, camera_mount, planar_pose
from advnerf_core.policies.load import load_any_policy
from advnerf_core.report.audit_result import audit_schema
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.lab import Lab
from nodes.audit.asking import UnansweredError
from nodes.audit.cars import CARS, car_of
from nodes.audit.images import posed
from nodes.audit.places import Answers, AuditedWorld, place_of_photographs
from nodes.audit.plan import AuditPlan
from nodes.audit.policies import resolve_policy
from nodes.audit.question import AuditedQuestion, Place
from nodes.cli.audit import PlaceOptions, _limit_m, _minutes
from nodes.cli.main import app
from nodes.experiment.show.experiment_world import as_json
from nodes.experiment.steps.run import load_experiment
from nodes.lab.importing.metric_options import MetricOptions
from nodes.runtime.errors import ConfigError
from tests.support import shut_world
from tests.support.warehouse import EXAMPLES


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--no-such-option"], "no such option"),
        (["--place", "nowhere"], "nowhere"),
        (["--world", "lab", "--place", "."], "expected either --place or --world"),
    ],
)
def test_wrong_options_are_no_verdict(tmp_path: Path, options: list[str], message: str) -> None:
    command = [sys.executable, "-m", "nodes.cli", "audit", "drivers:seduced", *options]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    found = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert (found.returncode, message in found.stderr) == (64, True), found.stderr


@pytest.mark.parametrize("text", ["40", "inf", "nan", "-1", "off-lane"])
def test_half_a_lane_is_in_metres(text: str) -> None:
    with pytest.raises(ConfigError, match="--limit: expected metres above 0 and at most 20, not cm or mm"):
        _limit_m(PlaceOptions(limit=text))


def test_the_schema_of_results_is_printed(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "nodes.cli", "audit", "--schema"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    found = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600, check=True
    )
    assert json.loads(found.stdout) == json.loads(json.dumps(audit_schema()))


@pytest.mark.parametrize(("text", "minutes"), [("90s", 1.5), ("10m", 10.0), ("2h", 120.0), ("5", 5.0)])
def test_a_budget_is_minutes_unless_it_says_otherwise(text: str, minutes: float) -> None:
    assert _minutes(text) == pytest.approx(minutes)


@pytest.mark.parametrize("text", ["soon", "-3m", "0s", ""])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="--budget: expected a time such as 90s"):
        _minutes(text)


def test_a_car_is_a_name_or_a_file(tmp_path: Path) -> None:
    assert car_of("roboracer") is CARS["roboracer"]
    (tmp_path / "mine.yaml").write_text("car: {speed_mps: 1.0, wheelbase_m: 0.3, max_steering_rad: 0.4}\n")
    assert car_of(str(tmp_path / "mine.yaml")).car.described.kind == "ackermann"
    assert CARS["duckiebot"].car.described.kind == "dubins"
    with pytest.raises(ConfigError, match="--car: expected a car"):
        car_of("tractor")
    (tmp_path / "bad.yaml").write_text("car: {speed_mps: 1.0, wheelbase_m: 0.3, max_steering_rad: 1.7}\n")
    with pytest.raises(ConfigError, match=r"less than 1\.5 rad"):
        car_of(str(tmp_path / "bad.yaml"))


@pytest.fixture
def openings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file with a line for each time that the shut world was opened."""
    monkeypatch.setenv(shut_world.LOG, str(tmp_path / "openings.txt"))
    (tmp_path / "openings.txt").touch()
    return tmp_path / "openings.txt"


def test_a_world_that_describes_itself_once_it_is_open_is_opened_once_for_path_camera_and_car(
    openings: Path,
) -> None:
    found = AuditedWorld(shut_world.NAME)
    assert found.place(None).path == "track"
    assert as_json(found.description) == as_json(Lab(LabConfig()).describe())
    assert len(openings.read_text().splitlines()) == 1


def test_a_world_is_not_opened_for_what_a_policy_and_the_path_declare(openings: Path, tmp_path: Path) -> None:
    world = AuditedWorld(shut_world.NAME)
    assert world.place("track").path == "track"
    own = next(Path(__file__).parents[3].glob("docs/results/reference/policy_*/policy.safetensors"))
    for given in ("grpc://127.0.0.1:1", str(own)):
        found = resolve_policy(given, lambda: pytest.fail("the world was asked"), (), tmp_path, print)
        assert found[0] == given
    assert not openings.read_text()


def test_a_random_policy_is_refused_before_its_place_is_learned(tmp_path: Path) -> None:
    """Its learned place was blamed, after minutes."""
    (tmp_path / "lots.py").write_text(
        "import torch\nfrom advnerf_core import PolicyContract, PolicyView, adapt\n"
        "from hardware.worlds.lab.config import LabConfig\n\n"
        "class Blind(torch.nn.Module):\n"
        "    def forward(self, images):\n        return 0.1 * torch.randn(len(images)) + 0 * images.mean((1, 2, 3))\n\n"
        "def factory():\n"
        "    view = PolicyView(LabConfig().camera.pinhole, width=80, height=40)\n"
        "    return adapt(Blind().eval(), PolicyContract(view))\n"
    )
    asked = ["lots:factory", "--world", "lab", "--limit", "0.4", "--budget", "1m", "-o", "audit"]
    command = [sys.executable, "-m", "nodes.cli", "audit", *asked]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    found = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert (found.returncode, "lots:factory: expected a policy that" in found.stderr) == (64, True), (
        found.stderr
    )
    assert "capture" not in found.stdout + found.stderr
    assert not list((tmp_path / "audit").rglob("capture"))


def test_a_network_with_weights_in_another_file_is_copied_with_them(tmp_path: Path) -> None:
    """As torch exports it by default; nothing but the file's content says how it steers."""
    onnx_models = pytest.importorskip("tests.support.onnx_models")
    given = tmp_path / "mine" / "model.onnx"
    onnx_models.save_beside(onnx_models.mean_model({"steering": 0.5}), given, weights="model.onnx.data")
    given.with_name("model.onnx.policy.yaml").unlink()
    driven = (LabConfig().camera.pinhole, 0.4)
    spec, camera = resolve_policy(str(given), lambda: driven, (), tmp_path / "audit", print)
    assert Path(spec).is_relative_to(tmp_path / "audit")
    assert camera == driven[0]
    before = load_any_policy(spec).sha256
    weights = Path(spec).with_name("model.onnx.data")
    weights.write_bytes(bytes(len(weights.read_bytes())))
    assert load_any_policy(spec).sha256 != before


def test_a_path_from_a_file_takes_ground_and_pitch_from_the_changes_of_the_experiment(tmp_path: Path) -> None:
    x_m = np.linspace(0.0, 2.0, 24)
    poses = [planar_pose(x, 0.0, 0.0) @ camera_mount(0.0, 0.0, 0.3, 0.1) for x in x_m]
    write_posed_images(
        tmp_path / "photos",
        poses,
        Pinhole(32, 24, 20.0, 20.0, 16.0, 12.0),
        lambda _: np.zeros((24, 32, 3), np.uint8),
        "png",
    )
    (tmp_path / "way.csv").write_text("x_m,y_m\n" + "\n".join(f"{x},0" for x in x_m))
    there = posed(tmp_path / "photos", tmp_path / "audit", MetricOptions(), in_metres=True)
    asked = (
        tmp_path / "photos",
        there,
        Answers(0.4, None, 0.3, str(tmp_path / "way.csv")),
        CARS["donkey"],
        None,
    )
    with pytest.raises(
        ConfigError, match=r"give both, for example --set world\.ground_z_m=0 --set world\.camera\.pitch"
    ):
        place_of_photographs(*asked)
    changes = ["world.ground_z_m=0", "world.camera.pitch_down_rad=0.1", "horizon=30"]
    place, limit_m = place_of_photographs(*asked, changes)
    assert (place.world["ground_z_m"], place.world["camera"]["pitch_down_rad"]) == (0, 0.1)
    assert (place.world["closed"], limit_m) == (False, 0.4)
    # Those who took the photographs held the camera elsewhere than the car does.
    on_ground = replace(there, ground_at_zero=True)
    with pytest.raises(UnansweredError, match="--camera-height"):
        place_of_photographs(
            tmp_path / "photos",
            on_ground,
            Answers(0.4, None, None, str(tmp_path / "way.csv")),
            CARS["donkey"],
            None,
            changes,
        )
    driven, _ = place_of_photographs(tmp_path / "photos", on_ground, Answers(0.4), CARS["donkey"], None)
    assert driven.world["camera"]["z_m"] == pytest.approx(0.3)
    for height_m, seen in ((0.34, True), (0.25, True), (0.6, False), (0.1, False)):
        asked = (tmp_path / "photos", on_ground, Answers(0.4, None, height_m), CARS["donkey"], None)
        if seen:
            assert place_of_photographs(*asked)[0].world["camera"]["z_m"] == height_m
        else:
            with pytest.raises(
                ConfigError, match=rf"in its photographs, 0\.3 m above the ground, got {height_m} m"
            ):
                place_of_photographs(*asked)


def test_a_learned_scene_without_its_images_cannot_be_judged_in(tmp_path: Path) -> None:
    (tmp_path / "scene.safetensors").touch()
    with pytest.raises(ConfigError, match="expected the images that this scene was learned from"):
        posed(tmp_path / "scene.safetensors", tmp_path / "audit", MetricOptions())


def test_a_world_with_an_experiment_file_is_driven_along_the_path_of_that_file() -> None:
    """Duckietown's first path by name turns left, and its experiment drives right."""
    assert AuditedWorld("duckietown").place(None).path == "right"
    assert AuditedWorld("duckietown").place("left").path == "left"


def test_a_world_of_ones_own_is_named_from_where_the_user_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(EXAMPLES)
    place = AuditedWorld("world_warehouse.py:Warehouse").place(None)
    question = AuditedQuestion("grpc://127.0.0.1:1", "a driver", place, None)
    file = AuditPlan.of(tmp_path / "audit", question).save()
    assert load_experiment(file, "place", [], tmp_path / "audit" / "place").world.off_track_m == 0.6
    assert (place.name, place.source) == ("world_warehouse.py:Warehouse", "world_warehouse.py:Warehouse")


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (
            "--world lab --car donkey --speed 2",
            "expected --car, --speed only with --place: a world has a car",
        ),
        (
            "--world lab --in-metres --up ground",
            "expected --in-metres, --length, .* or --up only with --place",
        ),
        ("--world lab --evaluations 5 --budget 2h", "expected one budget, got --budget and --evaluations"),
        ("--world lab --ci --budget 2h", "expected one budget, got --budget and --ci"),
        (
            "--world lab --length a b 4 --marker 0.2",
            "expected one source of the scale, got --length and --marker",
        ),
        ("--world lab --set gate=null", "got --set gate=null: it judges by a check of its own"),
        ("--world lab --set gate.victims=0.3", "got --set gate.victims=0.3: it judges by"),
        ("--place . --length a b -4", "with a length above 0 m, got -4"),
        ("--place . --length a b nan", "expected finite numbers for --length"),
    ],
)
def test_options_without_effect_and_contradictions_are_refused_with_the_code_of_usage(
    options: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    found = CliRunner().invoke(app, ["audit", "mine.onnx", *options.split()])
    assert found.exit_code == 64
    assert re.search(told, " ".join((found.output + found.stderr).split()))


def test_a_folder_keeps_the_budget_of_its_searches_and_no_refused_question(tmp_path: Path) -> None:
    question = AuditedQuestion(
        "file.onnx", "file.onnx", Place("lab", "world", "lab", "world", {"kind": "lab"}), 0.4, judging=20
    )
    other = replace(question, size_m=0.5)
    AuditPlan.of(tmp_path, question).save()
    plan = AuditPlan.of(tmp_path, other)  # of the first nothing was decided, as its world was misspelt
    assert plan.agreed(120.0, None) == (120.0, None)
    plan.decide(evaluations=60, minutes=15.0)
    again = AuditPlan.of(tmp_path, other)
    assert again.agreed(None, None) == again.agreed(15.0, None) == (15.0, 60)
    for asked in ((120.0, None), (None, 60)):
        with pytest.raises(
            ConfigError, match=r"were planned with, 15 min \(60 evaluations\); leave --budget"
        ):
            again.agreed(*asked)
    again.decide(evaluations=60, minutes=None)
    assert again.agreed(None, 60) == (None, 60)
    with pytest.raises(ConfigError, match=r"were planned with, 60 evaluations;"):
        again.agreed(15.0, None)
    with pytest.raises(ConfigError, match="where another policy, place, lane, car or object was asked about"):
        AuditPlan.of(tmp_path, question)
