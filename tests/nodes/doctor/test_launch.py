"""``advnerf doctor LAUNCH``: what a launch file needs here, with the emulators in the place of the car's devices."""

import json
import re
import shutil
import socket
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import typer
import yaml

from hardware.emulators.vesc_emulator import VescEmulator
from hardware.emulators.vesc_firmware import VescEmulatorConfig
from hardware.emulators.vicon_emulator import ViconEmulator, ViconEmulatorConfig
from hardware.mocap.vicon import ViconConfig, free_udp_port
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle
from nodes.cli import main as cli
from nodes.lab.doctor import files, general, graphics, launch, machine, motor
from nodes.lab.doctor.check import ABSENT, FAILURE, OK, WARNING, examine
from nodes.lab.doctor.launch import checks_of, pictures_of
from nodes.launching.launch_file import load_launch
from nodes.linking.keys import DRIVE, KeyFolder
from tests.support.faces import red_attack
from tests.support.live.processes import free_ports

ROOT = Path(__file__).parents[3]
TWIN = ROOT / "calibration" / "twin"
# Each of them starts as many processes as there are nodes; one test does, the others are about devices.
SLOW = ("nodes", "policy", "EGL")


def plan_of(name, *overrides, host=None):
    return load_launch(
        ROOT / "launch" / f"{name}.launch.yaml", [f"params.calibration={TWIN}", *overrides], host=host
    )


def findings(plan, folder, leave_out=SLOW):
    checks = [check for check in checks_of(plan, folder) if check.name not in leave_out]
    return list(examine(checks))


def states(rows, check):
    return [row.state for row in rows if row.check == check]


def test_the_twin_needs_its_files_a_port_and_a_disk(tmp_path):
    policy = tmp_path / "policy.safetensors"
    policy.touch()
    plan = plan_of("green_screen", f"params.policy={policy}", f"params.vicon_port={free_udp_port()}")
    assert [check.name for check in checks_of(plan, tmp_path)] == [
        "versions",
        "machine",
        "places",
        "sockets",
        "launches",
        "nodes",
        "calibration",
        "files",
        "EGL",
        "VICON",
        "policy",
        "disk",
    ]
    rows = findings(plan, tmp_path)
    assert states(rows, "calibration") == [OK]
    assert states(rows, "files") == [OK]
    assert states(rows, "VICON") == [OK]
    (disk,) = [row for row in rows if row.check == "disk"]
    assert "14.4 GB an hour" in disk.found
    assert pictures_of(plan).width == 336


def test_files_that_are_missing_or_damaged_are_named(tmp_path):
    attack = tmp_path / "a.attack.safetensors"
    attack.write_bytes(b"no attack")
    broken = tmp_path / "room.yaml"
    broken.write_text((TWIN / "room.yaml").read_text().replace("date:", "day:"))
    rows = findings(plan_of("green_screen", f"params.attack={attack}", f"safety.room={broken}"), tmp_path)
    found = {row.found for row in rows if row.state == FAILURE}
    assert "policy: no file policy.safetensors" in found
    assert any(str(broken) in text for text in found)
    assert states(rows, "attack") == [FAILURE]
    assert "policy" not in {
        check.name for check in checks_of(plan_of("green_screen"), tmp_path)
    }  # said under files


@pytest.fixture
def car():
    """The car's controller on a pty and a tracker that sends where it is."""
    eye = np.eye(4) + np.eye(4, k=3)
    tracker = ViconEmulator(ViconEmulatorConfig(port=free_udp_port()), lambda ns: {"car": eye, "board": eye})
    with VescEmulator(VescEmulatorConfig(), TwinVehicle(CarConfig())) as vesc:
        yield vesc, tracker.config.port
    tracker.close()


@pytest.mark.slow
def test_the_car_is_asked_for_what_its_launch_file_wants(car, tmp_path, monkeypatch):
    monkeypatch.setattr(launch.mocap, "LISTEN_S", 0.3)
    vesc, vicon_port = car
    overrides = [
        f"params.vesc={vesc.port}",
        f"params.vicon_port={vicon_port}",
        "params.camera={kind: v4l2, device: /dev/video99, width: 640, height: 480}",
    ]
    rows = findings(plan_of("robot", *overrides), tmp_path)
    assert states(rows, "VESC") == [OK]
    (timeout,) = [row for row in rows if row.check == "VESC time-out"]
    assert (timeout.state, "1000 ms with 0 A; required is at most 250 ms with 20 A" in timeout.found) == (
        FAILURE,
        True,
    )
    assert states(rows, "battery") == [OK]
    seen = {row.found.split(":")[0]: row.state for row in rows if row.check == "VICON"}
    assert (seen["car"], seen["board"], seen["wand is not seen"]) == (OK, OK, WARNING)
    (camera,) = [row for row in rows if row.check == "camera"]
    assert (camera.state, "expected a camera at /dev/video99, found none" in camera.found) == (FAILURE, True)
    assert states(rows, "gamepad")[0] in (OK, WARNING)  # teleop: hold


def test_devices_of_a_twin_that_is_switched_off_are_missed(tmp_path):
    # Not the usual port: the twin of another test may be sending there.
    real = ["vicon.source=127.0.0.1", f"vicon.port={free_udp_port()}"]
    rows = findings(plan_of("green_screen", "twin.if=false", *real), tmp_path)
    for check in ("camera", "VESC"):
        (row,) = [row for row in rows if row.check == check]
        assert (row.state, "this launch has no node that provides it" in row.found) == (FAILURE, True)
    assert states(rows, "VICON") == [FAILURE]  # a real stream is wanted now
    assert states(rows, "EGL") == []


def test_each_host_has_its_own_needs(tmp_path):
    watch, drive = free_ports(2)
    keys = KeyFolder(tmp_path / "keys")
    keys.new("robot")
    shared = [f"hosts.robot.watch_port={watch}", f"hosts.robot.drive_port={drive}", f"keys={keys.path}"]
    there = plan_of("two_hosts", *shared, "params.policy=p.onnx", host="workstation")
    names = [check.name for check in checks_of(there, tmp_path)]
    assert "VESC" not in names
    assert names[-3:] == ["clock", "network", "disk"]
    rows = findings(there, tmp_path)
    assert states(rows, "network") == [WARNING, WARNING]  # the car's launch does not run yet
    assert states(rows, "keys") == [FAILURE]  # no key of its own
    robot = plan_of("two_hosts", *shared, "camera.source={kind: folder, folder: nowhere}", host="robot")
    rows = findings(robot, tmp_path, (*SLOW, "VICON", "camera", "VESC"))
    assert states(rows, "network") == [OK, OK]
    assert [row.do for row in rows if row.check == "keys"] == [
        "advnerf car keys allow workstation --right drive"
    ]
    keys.add("workstation", KeyFolder(tmp_path / "there").new("workstation"))
    keys.allow("workstation", DRIVE)
    with socket.create_server(("127.0.0.1", watch)):
        rows = findings(robot, tmp_path, (*SLOW, "VICON", "camera", "VESC"))
        assert states(rows, "network") == [FAILURE, OK]
        assert "cannot listen on" in next(row.found for row in rows if row.check == "network")
    assert states(rows, "keys") == [OK]
    away = plan_of("two_hosts", *shared, "params.robot=203.0.113.7", host="robot")
    rows = findings(away, tmp_path, (*SLOW, "VICON", "camera", "VESC"))
    assert "(ip addr lists them)" in next(row.do for row in rows if row.check == "network")


def test_it_runs_where_no_large_library_is_installed():
    """As on the car; and none of them is imported into the doctor's own process where it is."""
    program = (
        "import sys\nfor name in ('torch', 'scipy', 'mujoco', 'numba', 'depthai', 'pygame', 'mitsuba', 'foxglove', 'av'): "
        "sys.modules[name] = None\nimport nodes.cli.doctor, nodes.lab.doctor.general, nodes.lab.doctor.launch, nodes.lab.doctor.probes"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=600, cwd=ROOT)


def run(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["advnerf", "doctor", *map(str, arguments)])
    try:
        cli.main()
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    return code, *capsys.readouterr()


def test_the_command_prints_one_line_per_finding_and_tells_by_its_exit_code(tmp_path, monkeypatch, capsys):
    file = tmp_path / "small.launch.yaml"
    room = yaml.safe_load((TWIN / "room.yaml").read_text())
    (tmp_path / "room.yaml").write_text(yaml.safe_dump(room))
    config = f"{{room: {tmp_path / 'room.yaml'}, vehicle: {TWIN / 'vehicle.yaml'}}}"
    file.write_text(f"name: small\nnodes:\n  safety: {{module: nodes.safety, config: {config}}}\n")
    code, output, _ = run(monkeypatch, capsys, file)
    lines = output.splitlines()
    assert code == 0
    assert any(
        line.startswith("ok       calibration") and str(tmp_path / "room.yaml") in line for line in lines
    )
    assert any("safety accept their configuration" in line for line in lines)
    assert lines[-1].startswith("0 failures")
    (tmp_path / "room.yaml").unlink()
    code, output, _ = run(monkeypatch, capsys, file, "--json")
    told = json.loads(output)
    assert (code, told["state"]) == (1, FAILURE)
    rows = [row for row in told["findings"] if row["check"] == "calibration"]
    assert (rows[0]["state"], "advnerf car calibrate" in rows[0]["do"]) == (FAILURE, True)


def test_what_the_command_cannot_understand_is_exit_code_2(tmp_path, monkeypatch, capsys):
    broken = tmp_path / "broken.launch.yaml"
    broken.write_text("name: broken\nnodes: [\n")
    assert run(monkeypatch, capsys, broken)[0] == 2
    assert run(monkeypatch, capsys, tmp_path / "none.launch.yaml")[0] == 2
    assert run(monkeypatch, capsys, ROOT / "launch" / "two_hosts.launch.yaml")[0] == 2  # which host?
    code, _, errors = run(monkeypatch, capsys, "--set", "twin.if=false")
    assert (code, "give one" in errors) == (2, True)


def test_a_computer_without_a_launch_file_in_mind(tmp_path, monkeypatch, capsys):
    for name in ("torch", "egl", "llvm", "screens"):  # processes that take seconds; tests of their own
        monkeypatch.setattr(graphics, name, lambda required=False: [])
    monkeypatch.setattr(machine, "clock", lambda: [])
    listening = partial(ViconConfig, port=free_udp_port())  # of no lab that runs beside this test
    monkeypatch.setattr(general, "ViconConfig", listening)
    code, output, _ = run(monkeypatch, capsys, "--folder", tmp_path, "--json")
    told = json.loads(output)["findings"]
    assert code == 0
    assert {
        "python",
        "extras",
        "machine",
        "home",
        "cache",
        "disk",
        "sockets",
        "keys",
        "VICON",
        "camera",
        "gamepad",
        "launches",
    } <= {row["check"] for row in told}
    assert ABSENT in {row["state"] for row in told if row["check"] == "VICON"}
    with VescEmulator(VescEmulatorConfig(), TwinVehicle(CarConfig())) as vesc:
        monkeypatch.setattr(motor, "FIXED_NAME", Path(vesc.port))
        code, output, _ = run(monkeypatch, capsys, "--folder", tmp_path)
    assert code == 1
    assert f"-> advnerf car motor set-timeout --vesc {vesc.port}" in output


@pytest.mark.slow  # imports torch, starts EGL and compiles with LLVM
def test_libraries_of_this_computer_answer(tmp_path):
    assert [row.state for row in (*graphics.torch(True), *graphics.egl(True))] == [OK, OK]
    assert graphics.llvm()[0].state in (OK, ABSENT, WARNING)


def saved_policy(file, width, height):
    from advnerf_core.geometry import Pinhole
    from advnerf_core.policies.pilotnet import PilotNet
    from advnerf_core.policies.policy_file import save_policy
    from advnerf_core.policies.view import PolicyView

    save_policy(file, PilotNet(), PolicyView(Pinhole(width, height, 174.0, 174.0, width / 2, height / 2)), {})
    return file


def test_launch_check_says_which_policy_does_not_fit_the_camera(tmp_path, monkeypatch, capsys):
    file = tmp_path / "policy.safetensors"
    missing = plan_of("green_screen", f"params.policy={file}")
    assert launch.policy_problems(missing) == [
        f"policy: expected a policy file at {file}, found none; give another with --set params.policy=FILE"
    ]
    saved_policy(file, 400, 224)
    (problem,) = launch.policy_problems(plan_of("green_screen", f"params.policy={file}"))
    assert problem.startswith(
        "policy: trained for 400 x 224, the camera is calibrated for 336 x 188; train for this"
    )
    monkeypatch.setattr("nodes.launching.launch_check.check_nodes", lambda plan: {})
    with pytest.raises(typer.Exit):
        cli._refuse(cli._problems(missing))
    assert "trained for 400 x 224" in capsys.readouterr().err


def test_a_calibration_of_the_future_is_told_and_starts(tmp_path):
    """A small computer without a battery may have the wrong clock."""
    shutil.copytree(TWIN, tmp_path / "twin")
    file = tmp_path / "twin" / "vehicle.yaml"
    file.write_text(re.sub(r"^date: .*", "date: 2999-01-01", file.read_text(), flags=re.M))
    policy = saved_policy(tmp_path / "policy.safetensors", 336, 188)
    plan = plan_of("green_screen", f"params.policy={policy}", f"params.calibration={tmp_path / 'twin'}")
    rows = files.calibrations(plan)
    assert [row.state for row in rows] == [OK, WARNING]
    assert "vehicle.yaml is from 2999-01-01, which is still to come" in rows[1].found
    assert files.unusable(plan) == []


@pytest.mark.parametrize(("name", "subject"), [("green_screen", "board"), ("monitor", "monitor")])
def test_a_target_by_which_the_attack_is_shown_turned_is_told_before_the_launch(tmp_path, name, subject):
    """The trials gave a table of it."""
    _, file = red_attack(tmp_path, subject)
    shutil.copytree(TWIN, tmp_path / "twin")
    plan = plan_of(name, f"params.attack={file}", f"params.calibration={tmp_path / 'twin'}")
    assert files.unusable(plan) == []
    target = tmp_path / "twin" / f"{subject}.yaml"
    document = yaml.safe_load(target.read_text())
    corners = document["corners_in_subject_m"]
    document["corners_in_subject_m"] = corners[2:] + corners[:2]
    target.write_text(yaml.safe_dump(document))
    (said,) = files.unusable(plan)
    assert "got a face upside down: they begin 2 corners later, at the bottom right one" in said


def test_a_margin_in_centimetres_is_told_before_the_launch_and_by_the_doctor():
    assert files.unusable(plan_of("green_screen", "safety.fence_margin_m=0.1")) == []
    wrong = plan_of("green_screen", "safety.fence_margin_m=10")
    (said,) = files.unusable(wrong)
    assert said.startswith("safety: expected safety.fence_margin_m of at most 1.50 m")
    assert said.endswith(
        "got 10 m (is it in cm?), by which the car could not be armed there; correct the launch file or the room"
    )
    assert [row.state for row in files.named(wrong) if row.check == "fence"] == [FAILURE]


def _no_folder(folder):
    return [
        "params.calibration=nosuch"
    ], r"nosuch/camera.yaml: no such calibration file; run advnerf car calibrate"


def _typo(folder):
    file = folder / "vehicle.yaml"
    file.write_text(file.read_text().replace("wheelbase_m", "whelbase_m"))
    return [f"params.calibration={folder}"], r"vehicle.yaml:\d+: unknown key whelbase_m"


def _swapped(folder):
    (folder / "camera.yaml").write_text((folder / "room.yaml").read_text())
    return [f"params.calibration={folder}"], r"camera.yaml:1: kind"


def _no_attack(folder):
    return ["params.attack=nosuch.safetensors"], "compositor: no file nosuch.safetensors; correct the path"


def _no_attack_of_any_kind(folder):
    return ["params.attack=nosuch"], "compositor: no file nosuch;"


def _broken_attack(folder):
    (folder / "a.safetensors").write_bytes(b"no attack")
    return [f"params.attack={folder / 'a.safetensors'}"], "a.safetensors"


@pytest.mark.parametrize(
    "spoil", [_no_folder, _typo, _swapped, _no_attack, _no_attack_of_any_kind, _broken_attack]
)
def test_launch_refuses_what_the_doctor_finds_of_files(tmp_path, monkeypatch, spoil):
    monkeypatch.setattr("nodes.launching.launch_check.check_nodes", lambda plan: {})
    policy = saved_policy(tmp_path / "policy.safetensors", 336, 188)
    folder = tmp_path / "twin"
    shutil.copytree(TWIN, folder)
    assert cli._cheap_problems(plan_of("green_screen", f"params.policy={policy}")) == []
    overrides, said = spoil(folder)
    plan = plan_of("green_screen", f"params.policy={policy}", *overrides)
    problems = cli._cheap_problems(plan)
    assert re.search(said, "\n".join(problems)), problems
    assert all("\n" not in each for each in problems)


@pytest.mark.slow  # a policy in a process of its own, and every node
def test_a_policy_is_loaded_and_timed(tmp_path):
    file = saved_policy(tmp_path / "policy.safetensors", 336, 188)
    plan = plan_of("green_screen", f"params.policy={file}")
    assert launch.policy_problems(plan) == []
    rows = findings(plan, tmp_path, ("EGL", "VICON"))
    assert states(rows, "nodes") == [OK]
    assert states(rows, "policy")[0] == OK
