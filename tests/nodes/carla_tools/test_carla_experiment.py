"""The whole experiment in the world carla, every stage of it in its smallest size, against the scripted server."""

import json

import numpy as np
import pytest
import yaml

from advnerf_core.data.transforms import load_transforms
from advnerf_core.report.clips import read_clip
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import runs_alone
from nodes.experiment.run.whole import run_experiment
from nodes.experiment.steps.keys import settings_hash
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError

TINY = {
    "gate": None,
    "capture": {"photos": 40, "held_out": 3},
    "scene": {"steps": 400, "log2_entries": 10, "finest": 32, "occupancy": 16},
    "object": {"car_resolution": 12, "hydrant_resolution": 10, "fit_steps": 0},
    "policy": {
        "deployed_stills": 2, "surrogate_stills": 2, "deployed_drives": 1, "surrogate_drives": 1, "drive_steps": 2, "dagger_rounds": 1,
        "first_steps": 2, "round_steps": 2, "naive_steps": 0, "hidden": [16, 8, 4],
    },
    "attack": {"evaluations": 1, "time_batch": 2}, "over": {"method": ["none", "gradient"]},
}  # fmt: skip
OBJECTS = [
    {"name": "car", "kind": "small_car", "x_m": -4.5, "y_m": 5.0},
    {"name": "hydrant", "kind": "hydrant", "x_m": -5.75, "y_m": -5.75},
]


@pytest.fixture
def file(tmp_path, settings):
    """An experiment file with one drive of three ticks."""
    camera = {**settings["camera"], "width": 336, "height": 188}  # the policy's view is cut from it
    world = {"kind": "carla", **settings, "camera": camera}
    data = {"name": "tiny", "horizon": 3, "paths": ["right"], "world": world, "objects": OBJECTS}
    file = tmp_path / "tiny.experiment.yaml"
    file.write_text(yaml.safe_dump({**data, "settings": {"tiny": TINY}}))
    return file


@pytest.mark.slow
def test_every_stage_runs_against_a_server_and_leaves_it_as_it_was(as_carla, file, tmp_path):
    run = tmp_path / "run"
    experiment = load_experiment(file, "tiny", [], run)
    with pytest.raises(ConfigError, match="run that stage first"):
        _ = experiment.references
    run_experiment(experiment)
    kept = json.loads((run / "capture" / "world.json").read_text())["description"]
    assert kept["off_track_m"] == experiment.world.off_track_m == pytest.approx(1.75)
    assert kept["facts"]["junction_id"] == 100
    assert len(load_transforms(run / "capture" / "photos", require_all=True).frames) == 40
    cell = json.loads((run / "cells" / "right_hardened_gradient_0.json").read_text())
    drives = json.loads((run / "cells" / "right_hardened_gradient_0" / "drives.json").read_text())["states"]
    path = experiment.paths["right"]
    totals_m = [np.abs(path.project(np.array(driven)[1:, :2]).cte_m).sum() for driven in drives]
    assert cell["deployed"]["total_cte_m"] == pytest.approx(totals_m)
    assert len(totals_m) == experiment.config.measure.starts
    assert len(read_clip(run / "report" / "right.mp4")) == 4  # three ticks and the start
    assert "the world carla" in (run / "report" / "report.html").read_text()
    assert not as_carla.world.get_settings().synchronous_mode
    assert as_carla.world.actors == []


def test_another_junction_than_the_captured_one_is_refused(as_carla, file, tmp_path):
    experiment = load_experiment(file, "tiny", [], tmp_path / "run")
    with experiment.open_world() as world:
        experiment.keep_world(world)
    kept = tmp_path / "run" / "capture" / "world.json"
    data = json.loads(kept.read_text())
    facts = {**data["description"]["facts"], "junction_id": 7}
    kept.write_text(json.dumps({**data, "description": {**data["description"], "facts": facts}}))
    with pytest.raises(ConfigError, match=r"with other facts.*another run folder"), experiment.open_world():
        pass
    assert as_carla.world.actors == []
    assert not as_carla.world.get_settings().synchronous_mode


def test_objects_are_held_against_the_lanes_once_these_are_known(as_carla, file, tmp_path):
    in_the_lane = [*OBJECTS, {"name": "bump", "kind": "hydrant", "x_m": -12.0, "y_m": -2.0}]
    changes = [f"objects={json.dumps(in_the_lane)}"]
    experiment = load_experiment(file, "tiny", changes, tmp_path / "run")  # nobody knows where the lanes are
    with experiment.open_world() as world:
        experiment.keep_world(world)
    with pytest.raises(ConfigError, match=r"bump reaches into a lane at \(-12"):
        _ = experiment.objects
    with pytest.raises(ConfigError, match=r"--set objects=.*bump reaches into a lane"):
        load_experiment(file, "tiny", changes, tmp_path / "run")
    # What was captured with other settings says nothing about these.
    assert not load_experiment(
        file, "tiny", [*changes, "world.junction.beyond_m=31"], tmp_path / "run"
    ).is_described


def test_the_servers_address_changes_no_cell_and_its_junction_does(as_carla, file, tmp_path):
    assert runs_alone(load_experiment(file, "tiny", [], tmp_path / "run"))

    def of(*changes):
        experiment = load_experiment(file, "tiny", list(changes), tmp_path / "run")
        return settings_hash(experiment, Cell("right", "hardened", "gradient", 0))

    assert of() == of("world.server.port=3000") == of("over.seed=[0,7]")
    assert of() != of("world.junction.beyond_m=31")


def test_ticks_that_the_server_cannot_make_are_refused_before_anything_is_run(file, tmp_path):
    with pytest.raises(ConfigError, match=r"whole steps of the world carla, 0\.1 s each, got 0\.25 s"):
        load_experiment(file, "tiny", ["dt_s=0.25"], tmp_path / "run")
    load_experiment(file, "tiny", ["dt_s=0.25", "world.render.fixed_delta_s=0.05"], tmp_path / "run")
