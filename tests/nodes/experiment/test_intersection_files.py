"""The experiment file, its stages, and which change redoes what."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nodes.experiment.engine.stages import run_stages
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps import run
from nodes.experiment.steps.pipeline import stages_of
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import Report
from tests.support.commands import advnerf

LAUNCH = Path(__file__).parents[3] / "launch" / "junction.experiment.yaml"


def load(folder: Path, *overrides: str) -> Experiment:
    return load_experiment(LAUNCH, "full", list(overrides), folder)


def test_paths_are_those_of_the_world_and_goals_are_exits(tmp_path: Path) -> None:
    experiment = load(tmp_path)
    for name, reference in experiment.references.items():
        along = np.arange(0.0, reference.length_m, 1.7)
        poses = np.array([reference.pose_at(float(s)) for s in along])
        np.testing.assert_allclose(experiment.paths[name].pose_at(along)[:, :2], poses[:, :2], atol=1e-9)
    goals = np.array([experiment.goal(name) for name in ("straight", "right", "left")])
    np.testing.assert_array_equal(goals, np.eye(3))  # exits: east, south, west


def test_starts_are_drawn_about_the_nominal_one(tmp_path: Path) -> None:
    experiment = load(tmp_path, "attack.starts=400", "attack.start_sigma=0.2")
    starts = experiment.start_states("left", 1).numpy()
    nominal = experiment.references["left"].start_pose
    np.testing.assert_array_equal(experiment.start_states("left", 0)[0], nominal)
    assert not np.array_equal(starts[0], nominal)
    np.testing.assert_allclose(starts.mean(axis=0), nominal, atol=0.04)
    np.testing.assert_allclose(starts.std(axis=0), [0.2, 0.2, 0.05], rtol=0.15)
    assert not np.array_equal(starts, experiment.start_states("left", 2).numpy())
    np.testing.assert_array_equal(starts, experiment.start_states("left", 1).numpy())


@pytest.mark.parametrize(
    ("override", "redone"),
    [
        ("scene.steps=3", {"scene"}),
        ("object.fit_steps=3", {"object"}),
        ("objects=[]", {"object", "policy"}),
        ("world.car.turn_rate_lag_s=0.2", {"policy"}),
        ("world.car.speed_mps=5", {"capture", "policy"}),
        ("world.road.lane_width_m=3.4", {"capture", "policy"}),
        ("horizon=50", {"bake"}),
        ("held_cap_m=5", set()),
        ("object.panel_rgb=[0.4, 0.5, 0.5]", {"policy"}),
        ("attack.evaluations=3", set()),
    ],
)
def test_a_change_redoes_only_what_reads_it(tmp_path: Path, override: str, redone: set[str]) -> None:
    # What a stage reads of the stages before it is the matter of tests/nodes/runtime/test_stages.py.
    before = {stage.name: stage.settings for stage in stages_of(load(tmp_path))}
    after = {stage.name: stage.settings for stage in stages_of(load(tmp_path, override))}
    assert {name for name in before if before[name] != after[name]} == redone


@pytest.mark.parametrize("override", ["measure.starts=4", "measure.seed=7"])
def test_a_retraining_that_is_judged_from_other_starts_is_judged_again(tmp_path: Path, override: str) -> None:
    retrains = "retrain={rounds: 1}"
    before, after = (
        {stage.name: stage.settings for stage in stages_of(load(tmp_path, retrains, *more))}
        for more in ((), (override,))
    )
    assert {name for name in before if before[name] != after[name]} == {"retrain"}


def test_every_shipped_experiment_names_its_world(tmp_path: Path) -> None:
    kinds = {
        file.name.partition(".")[0]: load_experiment(file, "full", [], tmp_path).named_world.kind
        for file in LAUNCH.parent.glob("*.experiment.yaml")
        if "\nsettings:" in file.read_text(encoding="utf-8")
    }
    assert kinds == {
        "room": "lab",
        "monitor": "lab",
        "junction": "junction",
        "carla": "carla",
        "metadrive": "metadrive",
        "duckietown": "duckietown",
    }


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"world": {"kind": "moon"}},
            "expected a world of lab, junction, carla, metadrive, duckietown, filament, photographs, scene; got 'moon'",
        ),
        ({"world": {"road": {}}}, "expected kind: NAME"),
        (
            {"paths": ["backwards"]},
            "paths: expected a path of straight, right, left; got 'backwards'",
        ),
        ({"paths": ["left", "left"]}, "expected different paths, got left, left"),
        (
            {"world": {"kind": "junction", "road": {"lane_width_m": 9.0}}},
            "road.lane_width_m: input should be less",
        ),
        (
            {"world": {"kind": "junction", "roads": {}}},
            "unknown key roads; valid keys here: approach_m, beyond_m, camera",
        ),
        (
            {"objects": [{"name": "one", "kind": "hydrant", "x_m": 0.0, "y_m": -3.6}]},
            "one reaches into a lane at (0.",
        ),
        ({"view": {"crop_top_px": 100}}, "view: expected a crop inside 336 x 188"),
        (
            {"world": {"kind": "junction", "camera": {"width": 640, "height": 480}}},
            "the same part of the image is 'view: {crop_top_px: 61, crop_height_px: 283}'",
        ),
        ({"polcy": {}}, "polcy"),
    ],
)
def test_bad_files_are_one_clear_error(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tiny_file: Callable[..., Path],
    changes: dict[str, object],
    said: str,
) -> None:
    file = tiny_file(**changes)
    words = ("experiment", "run", file, "--setting", "tiny", "--folder", tmp_path / "run")
    assert advnerf(monkeypatch, *words) == 2
    told = capsys.readouterr()
    assert said in told.out + told.err
    assert "Traceback" not in told.out + told.err
    assert not (tmp_path / "run").exists()


def test_unknown_setting_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="known are demo, full"):
        load_experiment(LAUNCH, "huge", [], tmp_path)


def test_retraining_without_the_gradient_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gradient among over\.method"):
        load(tmp_path, "retrain.rounds=1", "over.method=[none,random]")


def test_training_drives_that_end_before_the_junction_are_refused(tmp_path: Path) -> None:
    fine = ("dt_s=0.01", "horizon=600")
    said = r"policy\.drive_steps to be at least half of horizon = 600 ticks.* got 60 ticks of dt_s = 0\.01 s, 0\.6 s; set policy\.drive_steps=600"
    with pytest.raises(ConfigError, match=said):
        load(tmp_path, *fine)
    assert load(tmp_path, *fine, "policy.drive_steps=600").limits.ticks == 600
    assert load(tmp_path, *fine, "policy.dagger_rounds=0").limits.dt_s == 0.01  # it drives in no training
    with pytest.raises(ConfigError, match=r"retrain\.drive_steps.* got 60 ticks"):
        load(tmp_path, *fine, "policy.drive_steps=600", "retrain.rounds=1")
    assert (
        load(tmp_path, *fine, "policy.drive_steps=600", "retrain.drive_steps=600").config.retrain is not None
    )


class Quiet:
    """Takes what stages tell."""

    def start(self, stage: str) -> Callable[[float, str], None]:
        return lambda fraction, text="": None

    def finish(self, stage: str, seconds: float, cached: bool) -> None:
        pass


def test_cells_of_the_retrained_victim_wait_for_one_round_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stages write next to nothing here: what is asked for is decided by their records."""
    experiment = load(tmp_path, "retrain.rounds=6")
    asked: list[tuple[int, str]] = []

    def work(folder: Path, report: Report) -> None:
        (folder / "round0").mkdir(exist_ok=True)
        (folder / "round0" / "policy.safetensors").write_text("a victim")

    def make_ready(wanted: Experiment, until: str) -> None:
        assert wanted.config.retrain is not None
        asked.append((wanted.config.retrain.rounds, until))
        run_stages([replace(stage, run=work) for stage in stages_of(wanted)], wanted.folder, Quiet())

    monkeypatch.setattr(run, "make_ready", make_ready)
    run.prepare_victims(experiment)
    assert asked == [(1, "retrain")]
    run.prepare_victims(experiment)  # also of a longer loop it is the first round's victim
    assert asked == [(1, "retrain")]
    shutil.rmtree(experiment.folder / "retrain")
    run.prepare_victims(load(tmp_path, "retrain.rounds=4"))
    assert asked[1:] == [(1, "retrain")]
    run.prepare_victims(load(tmp_path, "retrain.rounds=6", "retrain.stills=7"))
    assert asked[2:] == [(1, "retrain")]
    longer = load(tmp_path / "longer", "retrain.rounds=6")

    def stopped(folder: Path, report: Report) -> None:
        if folder.name == "retrain":
            raise InterruptedError

    with pytest.raises(InterruptedError):
        run_stages([replace(stage, run=stopped) for stage in stages_of(longer)], longer.folder, Quiet())
    run.prepare_victims(longer)
    assert asked[3:] == [(6, "retrain")]  # begun, but no victim yet: nothing of it is thrown away
