"""What may be taken from a run folder: stages really run by the stage runner, with work that costs nothing in place of the hours."""

import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from nodes.experiment import attack, deploy
from nodes.experiment.cells import _cell, prepare
from nodes.experiment.finished import changed_settings, has_same_attacks, has_same_graph
from nodes.experiment.run import load_experiment, stages_of
from nodes.experiment.run_folder import run_to_end
from nodes.lab.trials.trial import NotStartedError
from nodes.runtime.errors import ConfigError

LAUNCH = Path(__file__).parents[3] / "launch"


def room(folder, *overrides):
    return load_experiment(LAUNCH / "room.experiment.yaml", "demo", overrides, folder)


def made(experiment, until=None):
    """The experiment's stages, with its settings, in its run folder; their work is a line of text."""

    def work(name):
        def run(folder, told):
            (folder / "out.txt").write_text(json.dumps(next(s.settings for s in stages if s.name == name)))
            if name == "attack":
                (folder / "frozen.json").write_text(json.dumps(dict.fromkeys(("scene", "victim"), "same")))

        return run

    stages = stages_of(experiment)
    cheap = [replace(stage, run=work(stage.name)) for stage in stages if stage.name != "report"]
    run_to_end(experiment, cheap, ["numpy"], lambda console: None, until, Console(file=io.StringIO()))
    return experiment


@pytest.fixture(autouse=True)
def frozen(monkeypatch):
    monkeypatch.setattr(
        attack, "frozen_hashes", lambda experiment: {"scene": "same", "victim": "same", "config": "?"}
    )


def test_a_folder_is_what_its_stages_were_made_with_whatever_was_asked_for_last(tmp_path):
    owner = made(room(tmp_path))
    assert changed_settings(owner) == []
    other = room(tmp_path, "policy.dagger_rounds=5", "attack.iterations=500")
    assert changed_settings(other) == ["policy.dagger_rounds"]
    made(other, until="scene")  # all of it is there already; the manifest is of these settings now
    assert changed_settings(other) == ["policy.dagger_rounds"]
    assert changed_settings(owner) == []
    with pytest.raises(ConfigError, match=r"was made with another policy\.dagger_rounds"):
        prepare(other, lambda fraction, text="": None)
    prepare(owner, lambda fraction, text="": None)


def test_a_stage_that_was_made_before_what_it_builds_on_is_not_taken(tmp_path):
    owner = made(room(tmp_path))
    made(room(tmp_path, "scene.steps=77"), until="scene")
    assert changed_settings(owner) == [
        "scene.steps",
        "policy (it was made before what it builds on)",
        "object (it was made before what it builds on)",
    ]
    assert changed_settings(room(tmp_path, "lab.car.speed_mps=0.6"))[:1] == ["lab.car"]


def test_attacks_of_other_settings_are_not_taken_and_the_cache_is_free(tmp_path):
    owner = made(room(tmp_path))
    assert has_same_attacks(owner)
    assert has_same_attacks(room(tmp_path, "attack.cache_mib=64", "attack.seeds=[4]"))
    assert not has_same_attacks(room(tmp_path, "attack.iterations=31"))
    assert not has_same_attacks(room(tmp_path, "horizon=61"))
    made(room(tmp_path, "attack.iterations=500"), until="scene")
    assert not has_same_attacks(room(tmp_path, "attack.iterations=500"))
    assert has_same_attacks(owner)


def test_folders_from_before_settings_were_kept_are_known_by_their_key(tmp_path):
    owner = made(room(tmp_path))
    for stage in ("capture", "scene", "policy", "object", "attack", "deploy"):
        record = tmp_path / stage / "stage.json"
        fields = json.loads(record.read_text())
        del fields["settings"]
        record.write_text(json.dumps(fields))
    assert changed_settings(owner) == []
    assert changed_settings(room(tmp_path, "policy.dagger_rounds=5")) == ["policy"]
    assert not has_same_attacks(owner)
    assert not has_same_graph(owner)


def driven(attack_ids, stopped_early="", off_track=False):
    return json.dumps(
        {"attack_ids": attack_ids, "outcome": {"stopped_early": stopped_early}, "off_track": off_track}
    )


def test_a_live_drive_is_taken_of_the_same_graph_the_same_attack_and_no_fault(tmp_path, monkeypatch):
    experiment = made(room(tmp_path / "run"))
    other = room(tmp_path / "run", "deploy.nodes=[twin, camera, vicon, policy, safety, motor, recorder]")
    assert has_same_graph(experiment)
    assert not has_same_graph(other)
    monkeypatch.setattr(
        "nodes.experiment.cells.load_attack", lambda path: type("Attack", (), {"attack_id": "abc"})
    )
    folder = tmp_path / "run" / "deploy"
    (tmp_path / "run" / "attack" / "hardened_gradient_0.json").touch()
    (tmp_path / "run" / "attack" / "hardened_none_0.json").touch()
    cell = _cell(experiment, "", "hardened", "gradient", 0, tmp_path / "cell")
    live = folder / "hardened_gradient_0.json"
    assert cell.driven_in("gradient") == tmp_path / "cell" / "live"
    for text, taken in (
        (driven(["abc"]), True),
        (driven(["old"]), False),
        (driven([]), False),
        (driven(["abc"], "outside of the fence"), True),
        (driven(["abc"], "no fresh pose"), False),
        (driven(["abc"], "stalled: ...", off_track=True), True),
        (driven(["abc"], "stalled: ..."), False),
    ):
        live.write_text(text)
        assert (cell.driven_in("gradient") == folder) is taken, text
    live.write_text(driven(["abc"]))
    assert _cell(other, "", "hardened", "gradient", 0, tmp_path / "cell").driven_in("gradient") != folder
    (folder / "hardened_none_0.json").write_text(driven([]))
    assert cell.driven_in("none") == folder


def test_a_drive_that_the_stack_stopped_is_driven_again_and_never_kept(tmp_path, monkeypatch):
    experiment, run = room(tmp_path), deploy.LiveRun("hardened", "gradient", 0)
    stops, told = ["no fresh pose", "never began", ""], []

    def drive(experiment, live, folder, attack):
        if stops[0] == "never began":
            raise NotStartedError(stops.pop(0))
        (folder / live.name).mkdir()  # which must be gone before it is driven again
        (folder / f"{live.name}.json").write_text(driven([], stops.pop(0)))

    monkeypatch.setattr(deploy, "drive_live", drive)
    deploy.drive_until_it_counts(experiment, run, tmp_path, None, told.append)
    assert len(told) == 2
    assert "no fresh pose (attempt 1 of 3)" in told[0]
    assert "never began (attempt 2 of 3)" in told[1]
    assert json.loads((tmp_path / f"{run.name}.json").read_text())["outcome"]["stopped_early"] == ""
    stops[:] = ["no fresh pose"] * 3
    with pytest.raises(
        deploy.DriveFault, match="stopped the live drive hardened_gradient_0 3 times, at last: no fresh"
    ):
        deploy.drive_until_it_counts(experiment, run, tmp_path, None, told.append)
    assert not (tmp_path / f"{run.name}.json").exists()
