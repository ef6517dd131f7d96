"""The motor node in this process, on an emulated controller behind a pty."""

import os
import pty
import time
import tty
from pathlib import Path

import pytest

from advnerf_core.documents import parse_yaml
from advnerf_core.strict import validate
from calibration.schema import VehicleCalibration, load_calibration, save_calibration
from hardware.emulators.vesc_emulator import VescEmulator
from hardware.emulators.vesc_firmware import VescEmulatorConfig
from hardware.motor.vesc import Vesc
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle
from nodes.motor import MotorConfig, MotorNode
from nodes.runtime.clock import SystemClock
from nodes.runtime.errors import ConfigError
from nodes.runtime.messages import drive_message, ns_from_stamp
from nodes.runtime.node import MessageInfo
from nodes.runtime.twin_port import claim_twins_port
from tests.support.safety_reports import state_message
from tests.support.stack import TIMEOUT
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live

TWIN = Path(__file__).parents[2] / "calibration" / "twin"
CLOCK = SystemClock()


class Drives:
    """A motor node on an emulator, and the safety node's commands to it."""

    def __init__(self, tmp_path, node_context):
        self.claim = claim_twins_port(node_context.run_dir)
        self.emulator = VescEmulator(
            VescEmulatorConfig(**TIMEOUT), TwinVehicle(CarConfig()), tmp_path / "vesc"
        )
        self.config = MotorConfig(port=str(tmp_path / "vesc"), calibration=TWIN / "vehicle.yaml")
        self.node = MotorNode.build(self.config, node_context)

    def send(self, speed, steering, stamp_ns=None):
        """A command of a safety node that reports at the same time: disarmed with a stop, armed with any other."""
        now = CLOCK.now()
        info = MessageInfo(now.mono_ns, now.mono_ns, instance_id=1)
        self.node.handle("/safety/state", state_message(now.real_ns, armed=speed != 0.0), info, now)
        command = drive_message(speed, steering, now.real_ns if stamp_ns is None else stamp_ns)
        return self.node.handle("/safety/drive", command, info, now)

    def run(self, duration_s):
        outs, deadline = [], time.monotonic() + duration_s
        while time.monotonic() < deadline:
            outs += self.node.tick(CLOCK.now())
            time.sleep(0.02)
        return outs

    def names(self):
        return [
            e.name
            for e in self.emulator.events()
            if e.name not in ("GET_VALUES", "FW_VERSION", "GET_APPCONF")
        ]


@pytest.fixture
def drives(tmp_path, node_context):
    drives = Drives(tmp_path, node_context)
    yield drives
    drives.node.close()
    drives.emulator.close()
    drives.claim.close()


def test_motor_connects_stops_and_waits_for_the_safety_node(drives):
    assert drives.node.status()[0] == "starting"
    outs = drives.run(0.3)
    assert {name for name in drives.names()} == {"SET_CURRENT_BRAKE"}
    assert drives.node.status() == ("starting", "latched: waiting for the safety node")
    sent = [o.message for o in outs if o.topic == "/motor/sent"]
    assert sent[-1].braking
    assert sent[-1].peer == "TWIN firmware 5.02"
    states = [o.message for o in outs if o.topic == "/motor/state"]
    assert states[-1].input_voltage_v == pytest.approx(15.2)
    drives.send(0.0, 0.0)
    state, text = drives.node.status()
    assert state == "ready"
    assert text == "TWIN firmware 5.02, own time-out 250 ms with 20 A"


def test_motor_obeys_and_reports_the_origin(drives):
    drives.run(0.1)
    drives.send(0.0, 0.0)
    stamp_ns = time.time_ns() - 77_777_777
    (out,) = drives.send(0.3, 0.1, stamp_ns)
    message = out.message
    assert ns_from_stamp(message.header.stamp) == stamp_ns
    assert not message.braking
    assert message.speed_mps == pytest.approx(0.3, abs=1e-3)
    assert abs(int(message.serial_write_mono_ns) - time.monotonic_ns()) < 60e9
    wait_for(lambda: drives.names()[-2:] == ["SET_SERVO_POS", "SET_RPM"], "the bytes on the wire")
    assert drives.node.status()[0] == "active"


def test_motor_reaches_the_commanded_speed_between_commands_but_does_not_repeat_itself(drives):
    drives.run(0.1)
    drives.send(0.0, 0.0)
    drives.send(0.8, 0.0)
    drives.run(0.1)
    drives.send(0.8, 0.0)
    drives.run(0.15)
    rpm = [e.value for e in drives.emulator.events() if e.name == "SET_RPM"]
    assert rpm == sorted(rpm)
    assert rpm[-1] == 3691.0
    drives.send(0.8, 0.0)
    count = len(drives.names())
    assert [o for o in drives.run(0.12) if o.topic == "/motor/sent"] == []
    assert len(drives.names()) - count <= 2  # what was still on its way


def test_motor_without_commands_brakes_then_lets_go(drives):
    drives.run(0.1)
    drives.send(0.0, 0.0)
    drives.send(0.5, 0.0)
    drives.run(1.6)
    names = drives.names()
    after = names[len(names) - 1 - names[::-1].index("SET_RPM") + 1 :]
    assert after[0] == "SET_CURRENT_BRAKE"
    assert after[-1] == "SET_CURRENT"
    assert drives.node.status()[0] == "fault"
    assert "latched: no fresh command" in drives.node.status()[1]


def test_motor_that_loses_its_controller_reports_it_and_comes_back_stopped(drives, tmp_path):
    drives.run(0.1)
    drives.send(0.0, 0.0)
    drives.send(0.5, 0.0)
    drives.emulator.close()
    drives.run(0.1)
    assert drives.node.status()[0] == "fault"
    assert drives.send(0.5, 0.0) == []
    drives.emulator = VescEmulator(VescEmulatorConfig(**TIMEOUT), TwinVehicle(CarConfig()), tmp_path / "vesc")
    drives.run(0.8)
    assert drives.send(0.5, 0.0) == []
    assert set(drives.names()) == {"SET_CURRENT_BRAKE"}
    drives.send(0.0, 0.0)
    assert drives.send(0.5, 0.0) != []


def test_motor_on_a_controller_that_is_silent(node_context):
    master, slave = pty.openpty()
    tty.setraw(slave)
    config = MotorConfig(port=os.ttyname(slave), calibration=TWIN / "vehicle.yaml")
    node = MotorNode.build(config, node_context)
    (out,) = node.tick(CLOCK.now())
    assert (out.topic, out.message.status[0].level) == ("/diagnostics", 2)
    assert node.status()[0] == "starting"
    assert "is this a VESC" in node.status()[1]
    node.close()
    os.close(master)
    os.close(slave)


def test_motor_brakes_when_it_is_told_to_end(drives):
    drives.run(0.1)
    drives.send(0.0, 0.0)
    drives.send(0.5, 0.0)
    drives.node.close()
    wait_for(lambda: drives.names()[-2:] == ["SET_CURRENT_BRAKE", "SET_CURRENT"], "the bytes on the wire")


def test_vehicle_file_reaches_the_driver():
    car = load_calibration(VehicleCalibration, TWIN / "vehicle.yaml")
    vesc = Vesc("/dev/null", car.vehicle_gains, car.drive_limits)
    assert vesc.gains.erpm(0.8) == pytest.approx(3691.2)


def test_a_limit_of_the_current_that_would_weaken_a_stop_is_refused(tmp_path):
    car = load_calibration(VehicleCalibration, TWIN / "vehicle.yaml")
    limits = car.limits.model_copy(update={"current_max_a": 5.0})
    save_calibration(car.model_copy(update={"limits": limits}), tmp_path / "vehicle.yaml")
    config = MotorConfig(port="/dev/null", calibration=tmp_path / "vehicle.yaml", brake_current_a=20.0)
    with pytest.raises(ConfigError, match=r"of at least brake_current_a, 20 A, got 5 A, which would weaken"):
        MotorNode.build(config, None)


@pytest.mark.parametrize("weak", ["brake_current_a: 0.02", "brake_hold_s: 0.0001"])
def test_a_stop_that_would_not_brake_is_refused(weak):
    text = f"port: /dev/null\ncalibration: {TWIN / 'vehicle.yaml'}\n{weak}\n"
    with pytest.raises(ConfigError, match=rf"{weak.split(':')[0]}: .* greater than or equal to"):
        validate(MotorConfig, parse_yaml(text, "motor.yaml"))
