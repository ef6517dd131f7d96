"""The whole experiment in its smallest size: real lab, real field, real node graph. What it finds is not judged, only that it runs."""

import json
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.attack.artifact import load_attack
from advnerf_core.driving.metrics import drive_metrics
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import run_cell
from nodes.experiment.run.gate import lacks, predict_cell
from nodes.experiment.run.run import Options
from nodes.experiment.run.whole import run_experiment
from nodes.experiment.steps import films, live
from nodes.experiment.steps.keys import driven_folder
from nodes.experiment.steps.run import load_experiment, make_ready
from nodes.lab.trials.evaluation import HOPS
from nodes.lab.trials.trial import SpoiledError
from nodes.launching.child import Child

LAUNCH = Path(__file__).parents[3] / "launch"
SMALL = [
    "capture.photos=80", "capture.colour_pairs=2", "capture.held_out=3", "scene.steps=150",
    "policy.deployed_stills=12", "policy.surrogate_stills=8", "policy.deployed_drives=2", "policy.surrogate_drives=2",
    "policy.drive_steps=4", "policy.first_steps=8", "policy.round_steps=4", "policy.naive_steps=0",
    "gate=null", "attack.horizon=8", "attack.evaluations=2", "carrier.resolution=8",
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("file", ["room", "monitor"])
def test_from_photographs_to_report_and_nothing_twice(tmp_path, file, monkeypatch):
    started, start = Counter(), Child.start
    monkeypatch.setattr(Child, "start", lambda child: (started.update([child.name]), start(child)))
    experiment = LAUNCH / f"{file}.experiment.yaml"
    first = run_experiment(load_experiment(experiment, "demo", SMALL, tmp_path))
    assert {end.how for end in first} == {"done"}
    page = (tmp_path / "report" / "report.html").read_text()
    assert "<html" in page
    table = json.loads((tmp_path / "report" / "table.json").read_text())
    assert {(row["domain"], row["method"]) for row in table["rows"] if row["excess_m"] is not None} == {
        (domain, method) for domain in ("surrogate", "deployed") for method in ("none", "random", "gradient")
    }
    assert "Missed control ticks: " in page
    cell = json.loads((tmp_path / "cells" / "track_hardened_gradient_0.json").read_text())
    (live,) = json.loads((tmp_path / "cells" / "track_hardened_gradient_0" / "drives.json").read_text())[
        "live"
    ]
    assert live["attack_ids"] == [cell["attack_id"]]
    # All drives share their nodes; only the recorder is started for each. A try that does not count ends them.
    drives = [json.loads(file.read_text()) for file in (tmp_path / "cells").glob("**/live0.json")]
    tries = sum(1 + len(drive["spoiled"]) for drive in drives)
    assert len(drives) == 3
    assert started["twin"] == 1 + tries - len(drives)
    assert started["recorder"] == tries
    kept = (tmp_path / "report" / "report.html").stat().st_mtime_ns
    assert run_experiment(load_experiment(experiment, "demo", SMALL, tmp_path)) == []
    assert (tmp_path / "report" / "report.html").stat().st_mtime_ns == kept


@pytest.mark.slow
def test_an_experiment_that_load_keeps_from_driving_live_ends_well_and_says_so(tmp_path, monkeypatch):
    """The attacked drive is spoiled every time, the others once; another command may try again."""
    tried = []

    def spoiled(experiment, run, folder, nodes):
        tried.append(run.attack)
        gradient = run.attack is not None and "gradient" in str(run.attack)
        if gradient or tried.count(run.attack) == 1:
            raise SpoiledError("12 of 59 control ticks had no new command; at most 5 may")
        start = experiment.references[run.scenario].drive_start
        states = np.array([[start[0] + 0.08 * k, start[1], 0.0] for k in range(61)])
        return planted_result(experiment, run, states)

    monkeypatch.setattr(live, "drive_live", spoiled)
    monkeypatch.setattr(films, "_deployed_track", lambda *given: planted_track(*given))
    experiment = load_experiment(LAUNCH / "room.experiment.yaml", "demo", SMALL, tmp_path)
    ended = run_experiment(experiment)
    assert {end.how for end in ended} == {"done"}
    page = (tmp_path / "report" / "report.html").read_text()
    assert "NOT DRIVEN LIVE: gradient (hardened, seed 0)" in page
    table = json.loads((tmp_path / "report" / "table.json").read_text())
    assert {(row["domain"], row["method"]) for row in table["rows"] if row["excess_m"] is not None} == {
        *(("surrogate", name) for name in ("none", "random", "gradient")),
        *(("deployed", name) for name in ("none", "random")),
    }
    assert {
        cell["method"]: (not cell["not_driven_live"], sum(map(len, cell["extra"]["spoiled_tries"])))
        for cell in table["cells"].values()
    } == {"none": (True, 1), "random": (True, 1), "gradient": (False, 3)}
    count = len(tried)
    again = load_experiment(LAUNCH / "room.experiment.yaml", "demo", SMALL, tmp_path)
    assert run_experiment(again) == []
    assert len(tried) == count
    options = Options(here=True, ready=True, retry=True)
    (end,) = run_experiment(again, options=options)
    assert "spoiled 6 times" in end.text
    assert len(tried) == count + 3


def planted_result(experiment, run, states):
    path = experiment.paths[run.scenario]
    metrics = drive_metrics(path, states, experiment.limits)
    attack = [] if run.attack is None else [load_attack(run.attack).attack_id]
    return {
        "victim": run.victim,
        "attack_ids": attack,
        "outcome": {"start_real_ns": 0, "end_real_ns": 6 * 10**9, "stopped_early": "", "peer": "TWIN"},
        "states": states.tolist(),
        "cte_m": path.project(states[:, :2]).cte_m.tolist(),
        "metrics": asdict(metrics),
        "frames": 60,
        "missed": 0,
        "capture_to_serial_ms": [50.0] * 60,
        "hops_ms": {name: [20.0] * 60 for name in HOPS},
    }


def planted_track(experiment, scene, space, cell, title, folder):
    """The film's track of a planted drive, which has no bag."""
    states = np.array(json.loads((folder / "drives.json").read_text())["states"][0])
    frames = [np.zeros((experiment.camera.height, experiment.camera.width, 3), np.uint8)] * len(states)
    return films._track(experiment, cell, title, frames, states)


@pytest.mark.slow
@pytest.mark.parametrize("file", ["room", "monitor"])
def test_a_face_is_also_deployed_without_nodes_and_meets_the_same_searches(tmp_path, file):
    """The second deployer: the lab's own car in this process, past the face that is drawn, or shown on the screen."""
    asked = [*SMALL, "deploy.through=world", "deploy.starts=null"]
    experiment = load_experiment(LAUNCH / f"{file}.experiment.yaml", "demo", asked, tmp_path)
    run_experiment(experiment)
    cell = Cell("track", "hardened", "random", 0)
    drives, clean = (
        json.loads((driven_folder(experiment, each) / "drives.json").read_text())
        for each in (cell, cell.clean)
    )
    assert drives["live"] == []
    assert np.shape(drives["states"]) == (1, 61, 3)
    # The face is seen: it steers otherwise than what is there without it.
    assert drives["commands"] != clean["commands"]
    assert "<html" in (tmp_path / "report" / "report.html").read_text()


@pytest.mark.slow
def test_a_cell_of_another_seed_is_searched_and_driven_live_once(tmp_path):
    experiment = load_experiment(LAUNCH / "monitor.experiment.yaml", "demo", SMALL, tmp_path / "run")
    make_ready(experiment, until="policy")
    asked = (
        experiment,
        Cell("track", "hardened", "gradient", 1),
        tmp_path / "cells" / "one",
        lambda fraction, text="": None,
    )
    cell = run_cell(*asked)
    assert len(cell["deployed"]["total_cte_m"]) == len(cell["deployed"]["none_total_cte_m"]) == 1
    live = json.loads((tmp_path / "cells" / "one" / "live0.json").read_text())
    assert live["attack_ids"] == [cell["attack_id"]]
    assert (tmp_path / "cells" / cell["extra"]["clip"]).stat().st_size > 1000
    assert run_cell(*asked)["deployed"] == cell["deployed"]
    # What a prediction needs is there: the search, and the bag of the drive without attack.
    folder = tmp_path / "cells" / "one"
    assert lacks(experiment, replace(asked[1], seed=2), tmp_path / "cells" / "two") == "its search"
    assert lacks(experiment, asked[1], folder) == ""
    found, clean = predict_cell(experiment, asked[1], folder, draws=9)
    assert found.attacked_m != found.none_m
    assert clean.agreement.summary()["views"] >= 10
