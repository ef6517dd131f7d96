"""What keeps a car from being armed before it can be trusted: telemetry, the controller's time-out, steering that was seen."""

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from advnerf_core.geometry import planar_pose
from hardware.emulators.vesc_emulator import VescEmulator
from hardware.emulators.vesc_firmware import VescEmulatorConfig
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle
from nodes.cli.main import app
from nodes.control.steering_check import CheckSettings, SteeringCheck
from nodes.motor import MotorConfig, MotorNode
from nodes.runtime.clock import Now, SystemClock
from nodes.runtime.messages import decode, encode, header, pose_message, types
from nodes.runtime.node import MessageInfo, NodeContext
from nodes.runtime.twin_port import claim_twins_port, is_twin, is_twins_port
from tests.support.faulty_devices import FaultyVescEmulator
from tests.support.messages import filled
from tests.support.safety_reports import state_message
from tests.support.stack import TIMEOUT
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live

CLOCK = SystemClock()
VEHICLE = Path(__file__).parents[2] / "calibration" / "twin" / "vehicle.yaml"


class Car:
    """A motor node on an emulator over a real pty, in time that the test gives out."""

    def __init__(self, tmp_path, config=None, twins_port=True, **vesc):
        self.claim = claim_twins_port(tmp_path) if twins_port else None
        self.emulator = FaultyVescEmulator(
            VescEmulatorConfig(**{"hardware_name": "60", **TIMEOUT, **vesc}), link=tmp_path / "vesc"
        )
        config = MotorConfig(port=str(tmp_path / "vesc"), calibration=VEHICLE, **(config or {}))
        self.node = MotorNode.build(config, NodeContext("motor", tmp_path, CLOCK))
        self.emulator_folder = tmp_path
        self.start = CLOCK.now()
        self.pose = (0.0, 0.0, 0.0)
        self.outs = []

    def now(self):
        return CLOCK.now()

    def settle(self, until):
        def settled():
            self.outs += self.node.tick(CLOCK.now())
            return until()

        wait_for(settled, f"the check; the node says {self.node.status()}")

    def say(self, action):
        message = types.SteeringCheck(
            header=header(CLOCK.now().real_ns), action=action, source="operator", ask_id=""
        )
        self.node.handle("/motor/check", message, MessageInfo(0, 0, instance_id=1), CLOCK.now())

    def rows(self):
        messages = [o.message for o in self.outs if o.topic == "/diagnostics"]
        decoded = decode("diagnostic_msgs/msg/DiagnosticArray", encode(messages[-1]))
        return {row.name: row for row in decoded.status}

    def close(self):
        self.node.close()
        self.emulator.close()
        if self.claim is not None:
            self.claim.close()


@pytest.fixture
def make(tmp_path):
    cars = []

    def build(config=None, **options):
        cars.append(Car(tmp_path, config, **options))
        return cars[-1]

    yield build
    for car in cars:
        car.close()


def known(car):
    return lambda: "settings" not in car.node.status()[1] and "telemetry" not in car.node.status()[1]


def test_a_car_nobody_has_seen_steering_is_not_ready(make):
    car = make()
    car.settle(lambda: "steering was not checked" in car.node.status()[1])
    assert car.node.status()[0] == "starting"


@pytest.mark.parametrize(
    ("config", "vesc"), [({"steering_check": "never"}, {}), ({}, {"hardware_name": "TWIN"})]
)
def test_who_is_exempt(make, config, vesc):
    car = make(config, **vesc)
    car.settle(lambda: car.node.status()[1] == "latched: waiting for the safety node")
    strict = SteeringCheck(CheckSettings(0.25))
    assert not strict.passed


@pytest.mark.parametrize(
    ("name", "twins_port", "is_the_twin"),
    [("TWIN", True, True), ("TWIN", False, False), ("TWINKLE", True, False), ("TWIN firmware", True, False)],
)
def test_the_twin_is_its_firmware_name_at_the_port_that_the_twin_made(make, name, twins_port, is_the_twin):
    car = make(hardware_name=name, twins_port=twins_port)
    settled = "latched: waiting for the safety node" if is_the_twin else "steering was not checked"
    car.settle(lambda: settled in car.node.status()[1])
    peers = {o.message.peer for o in car.outs if o.topic == "/motor/sent"}
    assert peers
    assert {is_twin(peer) for peer in peers} == {is_the_twin}


def test_a_twin_at_another_port_of_its_run_is_not_the_twin(make, tmp_path):
    """As a launch with two controllers would have it, or a link that leads elsewhere."""
    car = make()
    with VescEmulator(VescEmulatorConfig(), TwinVehicle(CarConfig()), tmp_path / "other"):
        assert not is_twins_port(tmp_path, str(tmp_path / "other"))
    assert is_twins_port(tmp_path, str(tmp_path / "vesc"))
    assert is_twins_port(tmp_path, car.emulator.port)
    assert not is_twins_port(tmp_path, "/dev/null")
    assert not is_twins_port(tmp_path, str(tmp_path / "nothing"))


def test_a_time_out_that_is_too_long_keeps_it_from_arming(make):
    """As a controller is delivered, which rolls on for a second and then coasts."""
    car = make({"steering_check": "never"}, timeout_ms=1000.0, timeout_brake_current_a=0.0)
    car.settle(lambda: "set-timeout" in car.node.status()[1])
    assert car.node.status()[0] == "starting"
    assert "at most 250 ms with at least 20 A, it is 1000 ms with 0 A" in car.node.status()[1]
    since = CLOCK.now().mono_ns
    drive(car, 0.0)
    drive(car, 0.5)  # from a safety node that does not wait for this one
    assert "set-timeout" in car.node._gate.reason
    assert not [each for each in car.emulator.events(since) if each.name == "SET_RPM" and each.value]
    accepted = {"controller_timeout_ms": 1000, "controller_brake_current_a": 0.0}
    car.node.close()
    car.node = MotorNode.build(
        MotorConfig(port=car.emulator.port, calibration=VEHICLE, steering_check="never", **accepted),
        NodeContext("motor", car.emulator_folder, CLOCK),
    )
    car.settle(lambda: car.node.status()[1] == "latched: waiting for the safety node")


def test_a_time_out_switched_off_is_never_good_enough(make):
    car = make({"steering_check": "never"}, timeout_ms=0.0)
    car.settle(lambda: "switched off" in car.node.status()[1])


def test_a_controller_that_does_not_tell_is_used_but_said_so(make):
    car = make({"steering_check": "never"}, readable_settings=False)
    car.settle(lambda: car.node.status()[1] == "latched: waiting for the safety node")
    car.settle(lambda: any(o.topic == "/diagnostics" and o.message.status[1].level == 0 for o in car.outs))
    assert car.rows()["motor: time-out"].level == 1
    assert "VESC Tool" in car.rows()["motor: time-out"].message


def test_a_silent_controller_is_braked_over_the_line_that_is_still_open(make):
    car = make({"steering_check": "never"})
    car.settle(lambda: car.node.status()[1] == "latched: waiting for the safety node")
    drive(car, 0.0)
    drive(car, 0.5)
    car.emulator.disturb("silent")
    since = CLOCK.now().mono_ns

    def has_failed():
        drive(car, 0.5)  # else the node may stop for a lack of commands first
        return car.node.status()[0] == "fault"

    car.settle(has_failed)
    car.settle(lambda: any(e.name == "SET_CURRENT_BRAKE" for e in car.emulator.events(since)))
    car.emulator.disturb(None)
    car.settle(lambda: "link fault" in car.node.status()[1] and car.node.status()[1].startswith("latched"))


def drive(car, speed):
    now = CLOCK.now()
    message = types.AckermannDriveStamped(
        header=header(now.real_ns),
        drive=filled(types.AckermannDrive, speed=speed),
    )
    info = MessageInfo(now.mono_ns, now.mono_ns, instance_id=1)
    car.node.handle("/safety/state", state_message(now.real_ns, armed=speed != 0.0), info, now)
    return car.node.handle("/safety/drive", message, info, now)


def test_diagnostics_and_odometry_are_standard_messages(make):
    car = make({"battery_warning_v": 16.0})
    car.emulator.report_fault(3)
    car.settle(lambda: any(o.topic == "/odom" for o in car.outs))
    car.settle(lambda: any(o.topic == "/diagnostics" and o.message.status[1].message for o in car.outs[-3:]))
    rows = car.rows()
    assert set(rows) == {"motor: controller", "motor: battery", "motor: time-out", "motor: steering"}
    odometry = decode(
        "nav_msgs/msg/Odometry", encode([o.message for o in car.outs if o.topic == "/odom"][-1])
    )
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "car")
    assert list(odometry.pose.covariance[[0, 7, 35]]) == [0.2, 0.2, 0.4]


# The check itself, with a car pushed by hand: its wheels are those of the simulated car.


def push(check, turns, speed=0.2, wheelbase=0.25, pushed_ms=(0, 9000), noise=(0.0, 0.0), seed=0):
    """Push a car in both positions; ``turns``: how much of the angle its wheels really take; noise of poses in m and rad."""
    x = y = yaw = 0.0
    rng = np.random.default_rng(seed)
    check.start(0)
    angle = 0.0
    for ms in range(0, 9000, 10):
        mono_ns = ms * 1_000_000
        told = check.steering_rad(mono_ns)
        if told is None:
            break
        angle += (turns * told - angle) * 0.1  # the servo needs its time
        step = speed * 0.01 * (pushed_ms[0] <= ms % 4000 < pushed_ms[1])
        yaw += step * math.tan(angle) / wheelbase
        x, y = x + step * math.cos(yaw), y + step * math.sin(yaw)
        dx, dy, turn = rng.normal(0.0, [noise[0], noise[0], noise[1]])
        check.pose(x + dx, y + dy, yaw + turn, mono_ns)
        check.tick(mono_ns)
    return check


@pytest.mark.parametrize("noise", [(0.0005, 0.001), (0.001, 0.002)])
@pytest.mark.parametrize(("turns", "passes"), [(1.0, True), (2.0, False), (0.3, False)])
def test_noise_of_a_standing_car_is_no_way_that_it_was_pushed(noise, turns, passes):
    """Pushed for a second of each four: the noise of the others had added up to as much, and halved the curvature."""
    for seed in range(5):
        check = push(
            SteeringCheck(CheckSettings(0.25)), turns, 0.4, pushed_ms=(2000, 3000), noise=noise, seed=seed
        )
        assert check.passed == passes, check.text


@pytest.mark.parametrize("speed", [0.2, -0.2])
def test_motion_capture_sees_wheels_that_turn(speed):
    check = push(SteeringCheck(CheckSettings(0.25)), 1.0, speed)
    assert (check.passed, check.text) == (True, "steering seen by motion capture")


@pytest.mark.parametrize("turns", [0.0, -1.0, 0.3])
def test_motion_capture_sees_wheels_that_do_not(turns):
    check = push(SteeringCheck(CheckSettings(0.25)), turns)
    assert not check.passed
    assert "with wheels turned left" in check.text
    assert "servo output off" in check.text


def test_a_car_that_was_not_pushed_waits_for_a_person():
    check = push(SteeringCheck(CheckSettings(0.25)), 1.0, speed=0.0)
    assert not check.passed
    assert check.text.endswith("confirm or deny")
    check.answer(True, "Ada", 9 * 10**9)
    assert (check.passed, check.text) == (True, "steering confirmed by Ada")
    check.start(10**10)
    check.answer(True, "Ada", 10**10 + 10**9)
    assert not check.passed  # too early: nothing was shown yet
    check.answer(False, "Ada", 10**10 + 9 * 10**9)
    assert (check.passed, check.showing) == (False, False)
    check.start(0)
    check.tick(69 * 10**9)
    assert "no answer" in check.text


def test_the_node_turns_the_wheels_and_listens_to_the_person(make):
    car = make({"steering_angle_rad": 0.15})
    car.settle(lambda: "steering was not checked" in car.node.status()[1])
    car.say("start")
    car.settle(lambda: any(e.name == "SET_SERVO_POS" for e in car.emulator.events()))
    servo = [e.value for e in car.emulator.events() if e.name == "SET_SERVO_POS"][-1]
    assert (servo - 0.5304) / -1.2135 == pytest.approx(0.15, abs=2e-3)
    assert not [e for e in car.emulator.events() if e.name == "SET_RPM"]
    later = CLOCK.now()
    for second in range(1, 10):  # the node knows no clock but the one it is given
        now = Now(later.mono_ns + second * 10**9, later.real_ns)
        car.node._watch.check.tick(now.mono_ns)
        car.node.handle(
            "/vicon/car",
            pose_message(planar_pose(0.0, 0.0, 0.0), now.real_ns),
            MessageInfo(0, 0, instance_id=1),
            now,
        )
    message = types.SteeringCheck(
        header=header(CLOCK.now().real_ns), action="confirm", source="operator", ask_id=""
    )
    car.node.handle("/motor/check", message, MessageInfo(0, 0, instance_id=1), now)
    assert "steering" not in car.node._watch.missing()


def test_a_repeated_request_for_the_check_is_obeyed_once_and_answered_every_time(make):
    car = make()
    car.settle(lambda: "steering was not checked" in car.node.status()[1])

    def ask(action, ask_id):
        message = types.SteeringCheck(
            header=header(CLOCK.now().real_ns), action=action, source="operator", ask_id=ask_id
        )
        car.outs += car.node.handle("/motor/check", message, MessageInfo(0, 0, instance_id=1), CLOCK.now())
        values = {pair.key: pair.value for pair in car.rows()["motor: steering"].values}
        return values["answered"], values["granted"], values["answer"]

    assert ask("confirm", "a") == ("a", "False", "no steering check is waiting for an answer; start one")
    assert ask("start", "b")[:2] == ("b", "True")
    began_ns = car.node._watch.check._began_ns
    assert ask("start", "b")[:2] == ("b", "True")
    assert car.node._watch.check._began_ns == began_ns
    assert ask("confirm", "a") == ("a", "False", "no steering check is waiting for an answer; start one")
    assert ask("jump", "c") == ("c", "False", "expected start, confirm or deny, got 'jump'")


def test_command_line(tmp_path):
    with VescEmulator(VescEmulatorConfig(), TwinVehicle(CarConfig()), tmp_path / "vesc") as emulator:
        port = ["--vesc", str(tmp_path / "vesc")]
        shown = CliRunner().invoke(app, ["car", "motor", "info", *port])
        assert shown.exit_code == 0, shown.output
        assert "TWIN firmware 5.02" in shown.output
        assert "1000 ms with 0 A" in shown.output
        stored = CliRunner().invoke(
            app, ["car", "motor", "set-timeout", "--timeout-ms", "250", "--brake-current", "20", *port]
        )
        assert stored.exit_code == 0, stored.output
        assert "was 1000 ms with 0 A, is 250 ms with 20 A" in stored.output
        assert str(emulator.firmware.timeout) == "250 ms with 20 A"
    assert CliRunner().invoke(app, ["car", "motor", "set-timeout", "--timeout-ms", "0"]).exit_code == 2


@pytest.mark.parametrize(
    ("answer", "code", "text"),
    [
        pytest.param("y", 0, "steering confirmed by operator"),
        pytest.param("n", 1, "steering denied by operator", marks=pytest.mark.slow),
    ],
)
def test_a_person_confirms_over_the_bus(tmp_path, answer, code, text):
    config = {"port": str(tmp_path / "vesc"), "calibration": str(VEHICLE), "steering_hold_s": 1.0}
    (tmp_path / "motor.json").write_text(json.dumps(config))
    car = TwinVehicle(CarConfig())
    with VescEmulator(VescEmulatorConfig(hardware_name="60", **TIMEOUT), car, tmp_path / "vesc") as emulator:
        command = [
            sys.executable,
            "-m",
            "nodes.motor",
            "--config",
            str(tmp_path / "motor.json"),
            "--folder",
            str(tmp_path),
        ]
        node = subprocess.Popen(command, cwd=Path(__file__).parents[2])
        try:
            wait_for(lambda: any(e.name == "GET_VALUES" for e in emulator.events()), "the motor node")
            done = CliRunner().invoke(
                app, ["car", "motor", "check-steering", "--folder", str(tmp_path)], input=answer + "\n"
            )
        finally:
            node.terminate()
            node.wait(120)
    assert done.exit_code == code, done.output
    assert text in done.output
    servo = [round((e.value - 0.5304) / -1.2135, 2) for e in emulator.events() if e.name == "SET_SERVO_POS"]
    assert {0.2, -0.2, 0.0} <= set(servo)
    assert not [e for e in emulator.events() if e.name == "SET_RPM"]
