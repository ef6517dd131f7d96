"""The shipped launch files: they resolve, and each node of a real car takes the configuration that is meant for it."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from nodes.lab.doctor import files
from nodes.launching.launch_check import check_nodes
from nodes.launching.launch_file import load_launch
from nodes.launching.launched import Launched, read_launched
from nodes.launching.one_car import mixtures, unprovided
from nodes.runtime.errors import ConfigError
from nodes.runtime.paths import RESOLVED_NAME

pytestmark = pytest.mark.live

LAUNCH = Path(__file__).parents[2] / "launch"


@pytest.mark.parametrize(
    ("file", "host", "nodes"),
    [
        (
            "monitor",
            None,
            {"twin", "camera", "vicon", "compositor", "monitor", "policy", "safety", "motor", "recorder"},
        ),
        (
            "page",
            None,
            {
                *(
                    "twin",
                    "camera",
                    "vicon",
                    "compositor",
                    "counterfactual",
                    "policy",
                    "safety",
                    "motor",
                    "page",
                ),
                "recorder",
            },
        ),
        ("robot", None, {"camera", "vicon", "safety", "motor", "recorder"}),
        (
            "ros2",
            None,
            {"twin", "camera", "vicon", "compositor", "ros2", "safety", "motor", "recorder"},
        ),
        ("ros2_car", None, {"compositor", "policy", "ros2", "safety", "recorder"}),
        ("workstation", None, {"compositor", "policy", "player", "recorder"}),
        ("two_hosts", "robot", {"camera", "vicon", "safety", "motor", "gateway"}),
        ("two_hosts", "workstation", {"compositor", "policy", "gateway", "recorder"}),
    ],
)
def test_each_starts_what_it_says(file, host, nodes):
    keys = ["keys=keys"] if host else []
    assert set(load_launch(LAUNCH / f"{file}.launch.yaml", keys, host=host).nodes) == nodes


@pytest.mark.parametrize(
    ("overrides", "host", "is_there"),
    [([], "workstation", True), (["record.host=robot"], "robot", True), ([], "all", False)],
)
def test_of_two_hosts_the_gateway_of_the_recorder_is_recorded(overrides, host, is_there):
    """It alone says in a bag that the link was down."""
    plan = load_launch(LAUNCH / "two_hosts.launch.yaml", ["keys=keys", *overrides], host=host)
    statuses = plan.documents["recorder"].data["statuses_of"]
    assert ("gateway" in statuses, "safety" in statuses) == (is_there, True)


def test_the_monitor_launch_shows_the_attack_on_the_monitor_only():
    plan = load_launch(LAUNCH / "monitor.launch.yaml", ["params.attack=a.safetensors"])
    assert plan.documents["monitor"].data["attack"] == "a.safetensors"
    assert plan.documents["compositor"].data["attack"] is None
    assert plan.documents["monitor"].data["display"]["kind"] == "twin"


def test_a_real_screen_and_no_twin_are_two_options():
    screen = "monitor.display={kind: screen, index: 1, connector: HDMI-A-1}"
    plan = load_launch(LAUNCH / "monitor.launch.yaml", ["twin.if=false", screen])
    assert "twin" not in plan.nodes
    assert plan.documents["monitor"].data["display"] == {
        "kind": "screen",
        "index": 1,
        "connector": "HDMI-A-1",
    }


def test_the_page_holds_the_button_that_the_safety_node_waits_for():
    plan = load_launch(LAUNCH / "page.launch.yaml")
    assert plan.documents["safety"].data["teleop"] == "hold"
    assert plan.documents["page"].data["host"] == "127.0.0.1"


MIXED = {
    "a real controller beside the twin": (
        ["motor.port=/dev/vesc"],
        r"expected motor\.port <run_dir>/vesc beside the node twin, got /dev/vesc: a real car would drive by simulated poses",
    ),
    "the simulated car's limits on a real one": (
        ["twin.if=false", "motor.port=/dev/vesc"],
        r"expected a measured motor\.calibration for the controller at /dev/vesc, got .*twin/vehicle\.yaml, the simulated car's",
    ),
    "a motor that the safety node does not wait for": (
        ["safety.nodes=[camera, vicon, policy]"],
        r"safety\.nodes|nodes: expected motor among safety\.nodes, got camera, vicon, policy: without it, the car drives without a check",
    ),
    "a camera that the safety node does not wait for": (
        ["safety.nodes=[vicon, policy, motor]"],
        r"expected camera among safety\.nodes, got vicon, policy, motor: without it, the car drives on after its camera has died",
    ),
    "a policy that is faster than allowed": (
        ["policy.speed_mps=1.4"],
        r"expected policy\.speed_mps of at most safety\.max_speed_mps, 1 m/s, got 1\.4",
    ),
    "two cars": (
        ["safety.vehicle=other/vehicle.yaml"],
        r"expected one vehicle file for safety and motor, got other/vehicle\.yaml and .*twin/vehicle\.yaml",
    ),
}


@pytest.mark.parametrize("what", MIXED)
def test_parts_of_different_cars_are_refused(what):
    overrides, told = MIXED[what]
    (said,) = check_nodes(load_launch(LAUNCH / "green_screen.launch.yaml", overrides)).values()
    assert re.search(told, said), said


def test_a_car_that_was_measured_is_one_car(tmp_path):
    for file in (LAUNCH.parent / "calibration" / "twin").iterdir():
        (tmp_path / file.name).write_text(file.read_text().replace("by construction", "measured"))
    real = ["twin.if=false", "motor.port=/dev/vesc", f"params.calibration={tmp_path}"]
    assert mixtures(load_launch(LAUNCH / "green_screen.launch.yaml", real)) == {}


@pytest.mark.parametrize("off", [[], ["safety.if=false", "motor.if=false"]])
def test_a_car_records_for_its_calibration_by_nominal_files(tmp_path, off):
    """As docs/first_day.md makes the first files: those that the calibration writes are not there yet."""
    for file in (LAUNCH.parent / "calibration" / "twin").iterdir():
        (tmp_path / file.name).write_text(
            file.read_text().replace("method: by construction", "method: nominal")
        )
    camera = "params.camera={kind: v4l2, device: /dev/video0, width: 336, height: 188}"
    plan = load_launch(LAUNCH / "robot.launch.yaml", [f"params.calibration={tmp_path}", camera, *off])
    assert "recorder" in plan.nodes
    assert [*check_nodes(plan), *files.unusable(plan), *files.missing(plan), *unprovided(plan)] == []


SCREEN = "monitor.display={kind: screen, index: 1, connector: HDMI-A-1}"
REAL_CAMERA = "camera.source={kind: folder, folder: pictures}"


@pytest.mark.parametrize(
    ("file", "settings", "missing"),
    [
        ("monitor", [], []),
        ("monitor", ["twin.if=false"], ["motor.port", "camera.source.path", "monitor.display.path"]),
        ("monitor", ["twin.if=false", SCREEN, REAL_CAMERA], ["motor.port"]),
        ("monitor", ["twin.if=false", SCREEN, REAL_CAMERA, "motor.port=/dev/vesc"], []),
        ("collect", ["twin.if=false"], ["motor.port", "camera.source.path"]),
        ("collect", ["twin.if=false", "camera.source={kind: socket, path: /tmp/own}"], ["motor.port"]),
        ("robot", [], []),
        ("workstation", [], []),
    ],
)
@pytest.mark.parametrize("placed", [True, False])
def test_a_device_that_only_the_simulated_lab_makes_is_missed_where_there_is_none(
    file, settings, missing, placed, tmp_path
):
    folder = tmp_path / "run" if placed else "<run_dir>"
    said = unprovided(load_launch(LAUNCH / f"{file}.launch.yaml", settings, folder))
    assert [re.search(r"expected a real device as (\S+), got", line)[1] for line in said] == missing


def test_the_check_of_a_launch_says_it(tmp_path):
    policy = "examples.my_policy:factory"
    settings = ["--set", "twin.if=false", "--set", f"params.policy={policy}"]
    program = [sys.executable, "-m", "nodes.cli", "launch", LAUNCH / "green_screen.launch.yaml", "--check"]
    done = subprocess.run(
        [*program, *settings], capture_output=True, text=True, cwd=LAUNCH.parent, timeout=600
    )
    assert done.returncode == 2
    assert "expected a real device as motor.port, got <run_dir>/vesc" in done.stderr


@pytest.mark.parametrize("check", [["--check"], []])
def test_the_port_of_a_twin_in_the_runs_folder_may_be_given_as_a_path(check, tmp_path):
    folder, link = tmp_path / "run", tmp_path / "link"
    link.symlink_to(tmp_path)
    program = [sys.executable, "-m", "nodes.cli", "launch", LAUNCH / "green_screen.launch.yaml", *check]

    def said(port):
        settings = ["--set", "twin.if=false", "--set", f"motor.port={port}", "--folder", folder]
        done = subprocess.run(
            [*program, *settings], capture_output=True, text=True, cwd=tmp_path, timeout=600
        )
        assert (done.returncode, folder.exists()) == (2, False)
        return done.stderr

    assert "expected a measured motor.calibration for the controller at" in said(tmp_path / "vesc")
    for port in (folder / "vesc", "run/vesc", link / "run" / "vesc"):
        assert said(port).startswith("error: policy: expected a policy file at")


@pytest.mark.parametrize("file", ["ros2", "ros2_car"])
def test_the_safety_node_watches_the_one_that_speaks_to_ros(file):
    plan = load_launch(LAUNCH / f"{file}.launch.yaml")
    watched = set(plan.documents["safety"].data["nodes"])
    assert "ros2" in watched
    assert watched <= set(plan.nodes)
    assert plan.documents["ros2"].data.get("interface", "lo") == "lo"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "host"),
    [
        ("monitor", None),
        ("page", None),
        ("robot", None),
        ("workstation", None),
        ("two_hosts", "all"),
        ("ros2", None),
        ("ros2_car", None),
    ],
)
def test_every_node_accepts_its_configuration(file, host):
    assert check_nodes(load_launch(LAUNCH / f"{file}.launch.yaml", host=host)) == {}


@pytest.mark.parametrize(
    "text", ["[]", "nodes: [motor]", "nodes: {motor: 3}", "nodes: {motor: {config: [3]}}"]
)
def test_a_resolved_file_that_was_edited_is_one_line(tmp_path, text):
    assert read_launched(tmp_path) == Launched()
    (tmp_path / RESOLVED_NAME).write_text("nodes: {motor: {module: nodes.motor, config: {port: /dev/vesc}}}")
    assert read_launched(tmp_path).car(tmp_path) == "a REAL car at /dev/vesc"
    (tmp_path / RESOLVED_NAME).write_text(text)
    with pytest.raises(ConfigError, match="expected nodes with their keys, as advnerf launch writes them"):
        read_launched(tmp_path)
