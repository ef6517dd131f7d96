import shutil
from pathlib import Path

import pytest

from nodes.experiment.attack import Search, searches
from nodes.experiment.deploy import live_runs
from nodes.experiment.run import STAGES, load_experiment, run_experiment, stages_of
from nodes.experiment.stages import StageError
from nodes.runtime.errors import ConfigError

ROOM = Path(__file__).parents[3] / "launch" / "room.experiment.yaml"


def room(tmp_path, setting="demo", *overrides):
    return load_experiment(ROOM, setting, overrides, tmp_path)


def test_settings_lie_over_the_file_and_the_command_line_over_both(tmp_path):
    assert room(tmp_path).config.attack.horizon == 40
    assert room(tmp_path, "full").config.attack.seeds == (0, 1, 2)
    changed = room(tmp_path, "full", "attack.horizon=30", "lab.car.speed_mps=0.6")
    assert (changed.config.attack.horizon, changed.speed_mps) == (30, 0.6)
    assert changed.config.object.resolution == 64


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["attack.iteration=3"], r"unknown key attack\.iteration; valid keys here: .*iterations"),
        (["attack.horizon=0"], r"attack\.horizon.*greater than or equal to 1"),
        (["attack.display_model=sometimes"], r"attack\.display_model.*valid boolean"),
        (["lab.camera.widht=3"], r"unknown key camera\.widht"),
        (["attack"], "expected KEY=VALUE"),
    ],
)
def test_a_wrong_value_is_one_error_with_the_way_out(tmp_path, overrides, message):
    with pytest.raises(ConfigError, match=message):
        room(tmp_path, "demo", *overrides)


def test_an_unknown_setting_names_those_there_are(tmp_path):
    with pytest.raises(ConfigError, match="no setting called 'huge'; known are demo, full"):
        room(tmp_path, "huge")


def test_an_error_names_the_line_of_the_file(tmp_path):
    file = tmp_path / "bad.experiment.yaml"
    file.write_text("name: room\nsettings:\n  demo:\n    attack:\n      horizen: 3\n")
    with pytest.raises(ConfigError, match=r"bad\.experiment\.yaml:5: unknown key attack\.horizen"):
        load_experiment(file, "demo", [], tmp_path)


def test_a_stage_depends_on_its_own_settings_and_on_no_others(tmp_path):
    before = {stage.name: stage.settings for stage in stages_of(room(tmp_path))}
    after = {stage.name: stage.settings for stage in stages_of(room(tmp_path, "demo", "attack.iterations=7"))}
    assert tuple(before) == STAGES
    assert {name for name in before if before[name] != after[name]} == {"attack", "deploy", "report"}


def test_every_seed_meets_every_condition_and_the_naive_victim_the_first(tmp_path):
    full = room(tmp_path, "full")
    assert Search("hardened", "gradient", 2) in searches(full)
    assert [s.seed for s in searches(full) if s.victim == "naive"] == [0, 0]
    runs = [run.name for run in live_runs(full)]
    assert runs[0] == "hardened_laps_0"
    assert {f"hardened_{c}_{s}" for c in ("none", "random", "gradient") for s in (0, 1, 2)} < set(runs)
    assert "hardened_empty_0" in runs
    assert len(runs) == len(set(runs))
    assert not any("laps" in run.name or "empty" in run.name for run in live_runs(room(tmp_path)))


def test_a_changed_node_graph_is_driven_again(tmp_path):
    for name in (ROOM.name, "green_screen.launch.yaml"):
        shutil.copy(ROOM.parent / name, tmp_path / name)
    experiment = load_experiment(tmp_path / ROOM.name, "demo", [], tmp_path / "run")
    before = {stage.name: stage.settings for stage in stages_of(experiment)}
    graph = tmp_path / "green_screen.launch.yaml"
    graph.write_text(graph.read_text().replace("timeout_ms: 250", "timeout_ms: 300"))
    after = {stage.name: stage.settings for stage in stages_of(experiment)}
    assert {name for name in before if before[name] != after[name]} == {"deploy"}


def test_an_unknown_last_stage_leaves_nothing_behind(tmp_path):
    experiment = load_experiment(ROOM, "demo", [], tmp_path / "run")
    with pytest.raises(StageError, match="got 'flight'"):
        run_experiment(experiment, "flight")
    assert not (tmp_path / "run").exists()
