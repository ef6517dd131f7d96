"""The whole experiment in its smallest size: real lab, real field, real node graph. What it finds is not judged, only that it runs."""

import json
import os
from pathlib import Path

import pytest

from advnerf_core.report.results import read_results
from nodes.experiment import fidelity
from nodes.experiment.campaign.gate import predict_cell
from nodes.experiment.campaign.kinds import load_kind
from nodes.experiment.cells import run_cell
from nodes.experiment.run import load_experiment, run_experiment

LAUNCH = Path(__file__).parents[3] / "launch"
SMALL = [
    "capture.walk_around=12", "capture.car_mounted=12", "capture.colour_pairs=2", "capture.held_out=2", "scene.steps=60",
    "policy.lab_stills=12", "policy.surrogate_stills=8", "policy.lab_drives=2", "policy.surrogate_drives=2",
    "policy.drive_steps=4", "policy.first_steps=8", "policy.round_steps=4", "policy.naive_steps=0",
    "attack.horizon=8", "attack.iterations=2", "attack.random_evaluations=2", "object.resolution=8",
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("file", ["room", "monitor"])
def test_from_photographs_to_report_and_nothing_twice(tmp_path, file):
    os.environ.setdefault("MUJOCO_GL", "egl")
    experiment = LAUNCH / f"{file}.experiment.yaml"
    first = run_experiment(load_experiment(experiment, "demo", SMALL, tmp_path))
    page = (tmp_path / "report" / "report.html").read_text()
    assert "<html" in page
    data = read_results(tmp_path / "report" / "results.json")
    assert {(run.domain, run.condition) for run in data.runs} == {
        (domain, condition)
        for domain in ("surrogate", "deployed")
        for condition in ("none", "random", "gradient")
    }
    assert data.latency is not None
    drawn = json.loads((tmp_path / "deploy" / "hardened_gradient_0.json").read_text())["attack_ids"]
    assert len(drawn) == 1
    kept = (tmp_path / "report" / "report.html").stat().st_mtime_ns
    again = run_experiment(load_experiment(experiment, "demo", SMALL, tmp_path))
    assert {name: record.digest for name, record in again.items()} == {n: r.digest for n, r in first.items()}
    assert (tmp_path / "report" / "report.html").stat().st_mtime_ns == kept


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_cell_of_another_seed_is_searched_and_driven_live_once(tmp_path):
    os.environ.setdefault("MUJOCO_GL", "egl")
    experiment = load_experiment(LAUNCH / "monitor.experiment.yaml", "demo", SMALL, tmp_path / "run")
    run_experiment(experiment, until="object")
    asked = (
        experiment,
        "monitor",
        "hardened",
        "gradient",
        1,
        tmp_path / "cells" / "one",
        lambda fraction, text="": None,
    )
    cell = run_cell(*asked)
    assert len(cell["deployed"]["total_cte_m"]) == len(cell["deployed"]["none_total_cte_m"]) == 1
    live = json.loads((tmp_path / "cells" / "one" / "live" / "hardened_gradient_1.json").read_text())
    assert live["attack_ids"] == [cell["attack_id"]]
    assert run_cell(*asked)["deployed"] == cell["deployed"]
    # What a prediction needs is there: the search, and the bag of the drive without attack.
    which = (experiment, "monitor", "hardened", "gradient")
    assert fidelity.lacks(*which, 2, tmp_path / "cells" / "one") == "its search"
    assert fidelity.lacks(*which, 1, tmp_path / "cells" / "one") == ""
    found, clean = predict_cell(load_kind("room"), *which, 1, tmp_path / "cells" / "one", draws=2)
    assert found.ratio > 0.0
    assert clean.agreement.summary()["views"] >= 10
