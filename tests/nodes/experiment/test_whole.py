"""The whole experiment in its smallest size: real lab, real field, real node graph. What it finds is not judged, only that it runs."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.report.results import read_results
from nodes.experiment.campaign.gate import predict_cell
from nodes.experiment.cell import Cell
from nodes.experiment.cells import run_cell
from nodes.experiment.keys import driven_folder
from nodes.experiment.kinds import load_kind
from nodes.experiment.run import load_experiment, make_ready
from nodes.experiment.whole import run_experiment

LAUNCH = Path(__file__).parents[3] / "launch"
SMALL = [
    "capture.photos=24", "capture.colour_pairs=2", "capture.held_out=3", "scene.steps=60",
    "policy.deployed_stills=12", "policy.surrogate_stills=8", "policy.deployed_drives=2", "policy.surrogate_drives=2",
    "policy.drive_steps=4", "policy.first_steps=8", "policy.round_steps=4", "policy.naive_steps=0",
    "attack.horizon=8", "attack.evaluations=2", "space.resolution=8",
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("file", ["room", "monitor"])
def test_from_photographs_to_report_and_nothing_twice(tmp_path, file):
    os.environ.setdefault("MUJOCO_GL", "egl")
    experiment = LAUNCH / f"{file}.experiment.yaml"
    first = run_experiment(load_experiment(experiment, "demo", SMALL, tmp_path), overrides=SMALL)
    assert {end.how for end in first} == {"done"}
    page = (tmp_path / "report" / "report.html").read_text()
    assert "<html" in page
    data = read_results(tmp_path / "report" / "results.json")
    assert {(run.domain, run.condition) for run in data.runs} == {
        (domain, condition)
        for domain in ("surrogate", "deployed")
        for condition in ("none", "random", "gradient")
    }
    assert data.latency is not None
    cell = json.loads((tmp_path / "cells" / "track_hardened_gradient_0.json").read_text())
    (live,) = json.loads((tmp_path / "cells" / "track_hardened_gradient_0" / "drives.json").read_text())[
        "live"
    ]
    assert live["attack_ids"] == [cell["attack_id"]]
    kept = (tmp_path / "report" / "report.html").stat().st_mtime_ns
    assert run_experiment(load_experiment(experiment, "demo", SMALL, tmp_path)) == []
    assert (tmp_path / "report" / "report.html").stat().st_mtime_ns == kept


@pytest.mark.slow
@pytest.mark.parametrize("file", ["room", "monitor"])
def test_a_face_is_also_deployed_without_nodes_and_meets_the_same_searches(tmp_path, file):
    """The second deployer: the lab's own car in this process, past the face that is drawn, or shown on the screen."""
    os.environ.setdefault("MUJOCO_GL", "egl")
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
    os.environ.setdefault("MUJOCO_GL", "egl")
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
    kind, folder = load_kind("experiment"), tmp_path / "cells" / "one"
    assert kind.lacks(experiment, replace(asked[1], seed=2), tmp_path / "cells" / "two") == "its search"
    assert kind.lacks(experiment, asked[1], folder) == ""
    found, clean = predict_cell(kind, experiment, asked[1], folder, draws=9)
    assert found.ratio > 0.0
    assert clean.agreement.summary()["views"] >= 10
