"""Live drives of an experiment: which there are, which count, and what a bag says of their end."""

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.driving.metrics import Horizon, drive_metrics
from advnerf_core.driving.path import Path as DrivingPath
from nodes.experiment.steps import live
from nodes.experiment.steps.pipeline import stages_of
from nodes.experiment.steps.run import load_experiment
from nodes.lab.trials.trial import SpoiledError
from nodes.launching.launch_file import load_launch
from nodes.runtime.errors import ConfigError

LAUNCH = Path(__file__).parents[3] / "launch"


def room(folder, *overrides, setting="demo"):
    return load_experiment(LAUNCH / "room.experiment.yaml", setting, overrides, folder)


def driven(states=(), stopped_early="", off_track=False):
    return {
        "outcome": {"stopped_early": stopped_early},
        "states": list(states),
        "metrics": {"off_track": off_track},
    }


def test_a_car_that_runs_into_something_stands_from_then_on():
    free = [[0.08 * tick, 0.0, 0.0] for tick in range(20)]
    # With the noise of motion capture.
    against_it = free + [[1.52 + 0.001 * (tick % 2), 0.0, 0.0] for tick in range(10)]
    assert live.blocked_tick(driven(free)) is None
    assert live.blocked_tick(driven(against_it)) == 19
    assert live.blocked_tick(driven(against_it, "the car is outside the fence")) is None
    assert live.blocked_tick(driven(against_it, "stalled for 1.0 s: the car does not move")) == 19


THROUGH_NODES = "deploy.through=nodes"


def test_live_nodes_take_measured_calibrations_and_changes_of_the_launch_file(tmp_path, monkeypatch):
    folder, change = tmp_path / "ours", "twin.vicon.latency_s=0.005"
    shutil.copytree(LAUNCH.parent / "calibration" / "twin", folder)
    wanted = [THROUGH_NODES, f"deploy.calibration={folder}", f'deploy.changes=["{change}"]', "deploy.laps=1"]
    run = live.LiveRun("live0", "hardened", "track", (0.0, 0.0, 0.0))
    experiment = room(tmp_path / "run", *wanted)
    for name in ("victim_spec", "victim_sha256"):  # there is no policy yet
        monkeypatch.setattr(live, name, lambda *_: "")
    overrides = live.live_overrides(experiment, run)
    twin = load_launch(experiment.launch_file, overrides).resolved["nodes"]
    assert twin["twin"]["config"]["vicon"] == {"port": 51001, "latency_s": 0.005}
    assert twin["motor"]["config"]["calibration"] == f"{folder}/vehicle.yaml"
    before = {stage.name: stage.settings for stage in stages_of(experiment)}["live"]
    # What results depend on is the content of the files, wherever they are.
    moved = folder.rename(tmp_path / "elsewhere")
    wanted[1] = f"deploy.calibration={moved}"
    assert {s.name: s.settings for s in stages_of(room(tmp_path / "run", *wanted))}["live"] == before
    (moved / "camera.yaml").write_text((moved / "camera.yaml").read_text() + "# measured again\n")
    assert {s.name: s.settings for s in stages_of(room(tmp_path / "run", *wanted))}["live"] != before


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([THROUGH_NODES, "deploy.camera=zed"], "at 10 Hz the first lost frame leaves the car without a command for 0.22 s"),
        ([THROUGH_NODES, "deploy.calibration=nowhere"], "expected a file or folder relative to this file"),
        ([THROUGH_NODES, f"deploy.calibration={LAUNCH / 'room.experiment.yaml'}"], "expected a folder relative to this file, got .* which is a file"),
        ([THROUGH_NODES, "deploy.camera=zed", 'deploy.changes=["motor.command_age_limit_s=0.21"]'], "without a command for 0.21 s"),
        ([THROUGH_NODES, 'deploy.changes=["twn.vicon.noise_m=0.001"]'], "no node called 'twn'; known are"),
        ([THROUGH_NODES, 'deploy.changes=["params.policy=mine.onnx"]'], "what the experiment itself does not set"),
        (['deploy.through=world', 'deploy.changes=["twin.vicon.noise_m=0.001"]'], r"expected deploy\.through nodes with deploy\.changes"),
        (["deploy.through=nothing", "deploy.camera=webcam"], r"expected deploy\.through world or nodes with deploy\.camera"),
    ],
)  # fmt: skip
def test_a_wrong_change_of_the_graph_is_one_error_before_anything_is_made(tmp_path, overrides, message):
    with pytest.raises(ConfigError, match=message):
        room(tmp_path, *overrides)


def test_laps_are_measured_with_the_limits_of_the_experiment(tmp_path):
    experiment = room(tmp_path, "held_cap_m=4", "horizon=40")
    laps = live._horizon(experiment, live.LiveRun("laps", "hardened", "track", (0.0, 0.0, 0.0), ticks=400))
    assert laps == replace(experiment.limits, ticks=400)
    assert laps.held_cap_m == 4.0


def test_lost_frames_are_driven_where_the_motor_node_bears_them(tmp_path):
    change = 'deploy.changes=["motor.command_age_limit_s=0.25"]'
    assert room(tmp_path, THROUGH_NODES, "deploy.camera=zed", change).config.deploy.camera.lost > 0.0


def test_a_spoiled_drive_is_driven_again_and_its_reasons_are_kept(tmp_path, monkeypatch):
    experiment = room(tmp_path)
    run = live.LiveRun("live0", "hardened", "track", (0.0, 0.0, 0.0))
    reasons, told = ["the stack stopped the car: no pose of the car for 0.21 s", "12 of 59 ticks"], []

    def drive(experiment, run, folder, nodes):
        if reasons:
            raise SpoiledError(reasons.pop(0))
        return driven(stopped_early="the car is outside the fence")

    monkeypatch.setattr(live, "drive_live", drive)
    found = live.drive_until_it_counts(experiment, run, tmp_path, told.append, live.LiveNodes(experiment))
    assert found["spoiled"] == ["the stack stopped the car: no pose of the car for 0.21 s", "12 of 59 ticks"]
    assert len(told) == 2
    reasons[:] = ["late"]
    # It is there: nothing is driven, and nothing could be.
    assert (
        live.drive_until_it_counts(experiment, run, tmp_path, told.append, live.LiveNodes(experiment))
        == found
    )


def test_a_live_run_reads_as_any_deployed_drive(tmp_path):
    path = DrivingPath.rounded_square(4.0, 1.1)
    states = np.array([[-0.9 + 0.08 * tick, -2.0 + 0.01 * tick, 0.0] for tick in range(21)])
    metrics = drive_metrics(path, states, Horizon(20))
    kept = json.loads(json.dumps({**driven(states.tolist()), "metrics": asdict(metrics)}))
    drive = live.as_drive(room(tmp_path), kept)
    assert drive.metrics == metrics
    assert np.array_equal(drive.states, states)
    assert (drive.blocked_tick, drive.collided_with) == (None, None)


def test_a_live_run_that_stood_still_says_against_what(tmp_path):
    path = DrivingPath.rounded_square(4.0, 1.1)
    # Eastwards to the bare wall at x = 4 m; the rear axle stays half a metre behind it.
    x_m = np.minimum(2.4 + 0.08 * np.arange(21), 3.6)
    states = np.stack([x_m, np.full(21, -1.5), np.zeros(21)], axis=1)
    metrics = drive_metrics(path, states, Horizon(20))
    kept = {**driven(states.tolist()), "metrics": asdict(metrics)}
    drive = live.as_drive(room(tmp_path), kept)
    assert drive.blocked_tick == 15
    assert drive.collided_with == "wall"


def test_laps_and_the_empty_scene_are_driven_where_they_are_asked_for(tmp_path):
    assert live.extra_runs(room(tmp_path)) == {}
    full = live.extra_runs(room(tmp_path, setting="full"))
    assert set(full) == {"laps", "empty"}
    # Three laps of a square of 4 m with corners of 1.1 m, at 0.8 m/s and 10 Hz.
    length_m = 4 * 1.8 + 2 * np.pi * 1.1
    assert full["laps"].ticks == round(3 * length_m / 0.08)
    assert full["empty"].start == (-1.1, -2.0, 0.0)


def test_live_nodes_simulate_the_lab_alone(tmp_path):
    junction = LAUNCH / "junction.experiment.yaml"
    with pytest.raises(
        ConfigError, match=r"expected carrier\.kind overlay or screen.*with deploy\.through nodes"
    ):
        load_experiment(junction, "demo", ["deploy.through=nodes"], tmp_path)
    with pytest.raises(ConfigError, match=r"expected world\.kind lab with deploy\.through nodes"):
        load_experiment(
            junction, "demo", ["deploy.through=nodes", "carrier.kind=overlay", "objects=[]"], tmp_path
        )
