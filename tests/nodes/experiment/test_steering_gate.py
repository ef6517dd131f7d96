"""A learned scene that lacks what the policy steers by is not attacked, unless the user says so."""

import json

import numpy as np
import pytest
from rich.console import Console

from nodes.experiment.run import whole
from nodes.experiment.run.run import Options
from nodes.experiment.steps.run import load_experiment
from nodes.experiment.steps.steering_gate import other_steering
from nodes.runtime.errors import RuntimeFault
from tests.support.stage_versions import ROOT, TINY

REFERENCE = ROOT / "docs" / "results" / "reference"
FILE = ROOT / "launch" / "room.experiment.yaml"


def rows(real, learned):
    return [{"real": a, "surrogate": b} for a, b in zip(real, learned, strict=True)]


@pytest.mark.parametrize("folder", sorted(REFERENCE.glob("policy_*")), ids=lambda folder: folder.name)
def test_scenes_of_published_experiments_pass(folder):
    kept = json.loads((folder / "policy.json").read_text())
    assert other_steering(kept["on_held_out_views"], kept["control_unit"]) == ""


def test_a_scene_without_the_wall_by_which_the_car_steers_is_refused():
    real = 0.2 * np.sin(np.arange(24))
    noise = 0.005 * np.cos(3 * np.arange(24))
    assert other_steering(rows(real, real + noise), "rad") == ""
    lacking = real + noise
    lacking[6:12] = 0.0  # there the policy sees nothing and goes straight on
    said = other_steering(rows(real, lacking), "rad")
    assert "on 24 held-out views its control differs by 0.0" in said
    assert "worst in view" in said
    scaled = other_steering(rows(9 * real, 9 * lacking), "rad/s")
    assert "rad/s" in scaled, "the rule has no unit"
    assert other_steering(rows(9 * real, 9 * (real + noise)), "rad/s") == ""


def test_a_policy_that_steers_alike_everywhere_passes_only_if_it_does_in_the_scene_too():
    assert other_steering(rows([0.1] * 5, [0.1] * 5), "rad") == ""
    assert other_steering(rows([0.1] * 5, [0.2] * 5), "rad") != ""
    assert other_steering(rows([0.1] * 5, [0.1, 0.1, 0.1, 0.1, 0.2]), "rad") != ""


def test_a_refused_scene_ends_the_experiment_with_one_line_and_the_key(tiny_room, monkeypatch):
    folder = tiny_room[0]
    changes = [each for each in TINY if not each.startswith("gate")]
    experiment = load_experiment(FILE, "demo", changes, folder)
    assert experiment.config.gate == "steering"
    views = folder / "policy" / "policy.json"
    kept = json.loads(views.read_text())
    assert other_steering(kept["on_held_out_views"], "rad") != "", "twelve steps learn nothing"
    with pytest.raises(RuntimeFault, match=r"lacks what the policy steers by.*--no-gate, or gate: null"):
        whole.run_experiment(experiment)
    monkeypatch.setattr(whole, "run_cells", lambda *_: [])
    console = Console(record=True, width=400)
    whole.run_experiment(experiment, None, Options(here=True, gate=False), console=console)
    assert "fidelity gate: victim hardened: the learned scene lacks" in console.export_text()
