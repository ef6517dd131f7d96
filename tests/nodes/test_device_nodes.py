"""The device nodes in this process, each against its real protocol: frame socket, UDP, pty."""

import math
import os
import pty
import socket
import time
import tty
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from advnerf_core.geometry import planar_pose
from calibration.schema import CalibrationError, CameraCalibration, VehicleCalibration, load_calibration
from hardware.cameras.interface import Frame
from hardware.twin.config import CarConfig
from hardware.twin.frame_server import FrameServer
from hardware.twin.vehicle import TwinVehicle
from hardware.twin.vesc_emulator import VescEmulator
from hardware.twin.vesc_firmware import VescEmulatorConfig
from hardware.vesc import Vesc
from hardware.vicon_codec import encode_blocks, object_pose
from nodes.arming import ArmingLimits
from nodes.camera import CameraConfig, CameraNode
from nodes.motor import MotorConfig, MotorNode
from nodes.runtime.clock import Now, SystemClock
from nodes.runtime.errors import RuntimeFault
from nodes.runtime.messages import (
    drive_message,
    header,
    image_array,
    ns_from_stamp,
    pinhole_from_camera_info,
    pose_matrix,
    types,
)
from nodes.runtime.node import MessageInfo, NodeContext
from nodes.safety import SafetyConfig, SafetyNode
from nodes.vicon import ViconNode, ViconNodeConfig

TWIN = Path(__file__).parents[2] / "calibration" / "twin"
CLOCK = SystemClock()


def context(tmp_path):
    return NodeContext("node", tmp_path, CLOCK)


def take(node, timeout_s=2.0):
    """Let the inbox wake the node, as the loop does."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if items := node.inbox.take():
            return [out for item in items for out in node.receive(item, CLOCK.now())]
        time.sleep(0.002)
    return []


# Camera


def frame(sequence=0, age_s=0.0, shape=(188, 336, 3)):
    now = CLOCK.now()
    age_ns = round(age_s * 1e9)
    return Frame(np.full(shape, sequence, dtype=np.uint8), now.real_ns - age_ns, now.mono_ns - age_ns, sequence)


@pytest.fixture
def camera(tmp_path):
    config = CameraConfig.model_validate(
        {"source": {"kind": "socket", "path": tmp_path / "frames"}, "calibration": TWIN / "camera.yaml"}
    )
    node = CameraNode.build(config, context(tmp_path))
    yield node
    node.close()
    node.inbox.close()


def connected(server):
    deadline = time.monotonic() + 3.0
    while server.clients == 0:
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return server


def test_camera_publishes_frames_with_their_own_stamps(camera, tmp_path):
    assert camera.status()[0] == "starting"
    with FrameServer(tmp_path / "frames") as server:
        connected(server).publish(sent := frame(3))
        image, info = take(camera)
    assert (image.topic, info.topic) == ("/camera/image_raw", "/camera/camera_info")
    assert (
        ns_from_stamp(image.message.header.stamp) == ns_from_stamp(info.message.header.stamp) == sent.stamp_realtime_ns
    )
    np.testing.assert_array_equal(image_array(image.message), sent.rgb)
    assert pinhole_from_camera_info(info.message).cx == 168.0
    assert camera.status() == ("active", "")


def test_camera_counts_gaps_drops_what_is_old_and_survives_a_restart_of_its_device(camera, tmp_path):
    with FrameServer(tmp_path / "frames") as server:
        connected(server).publish(frame(0))
        assert len(take(camera)) == 2
        server.publish(frame(5))
        assert len(take(camera)) == 2
        server.publish(frame(6, age_s=0.5))
        assert take(camera, 0.2) == []
    counted = camera.counters()
    assert (counted["frames_stale"], counted["frames_missed"]) == (1, 4)
    time.sleep(0.6)
    assert camera.status()[0] == "fault"
    with FrameServer(tmp_path / "frames") as server:
        connected(server).publish(frame(0))
        assert len(take(camera)) == 2
    assert camera.status()[0] == "active"


def test_camera_refuses_frames_it_is_not_calibrated_for(camera, tmp_path):
    with FrameServer(tmp_path / "frames") as server:
        connected(server).publish(frame(shape=(188, 366, 3)))
        with pytest.raises(RuntimeFault, match=r"336 x 188.*got 366 x 188: calibrate"):
            take(camera)


def test_camera_subtracts_the_measured_latency(tmp_path):
    calibration = load_calibration(CameraCalibration, TWIN / "camera.yaml").model_copy(update={"latency_s": 0.03})
    config = CameraConfig.model_validate(
        {"source": {"kind": "socket", "path": tmp_path / "f"}, "calibration": TWIN / "camera.yaml"}
    )
    node = CameraNode(config, calibration)
    image, _ = node.receive(sent := frame(), CLOCK.now())
    assert ns_from_stamp(image.message.header.stamp) == sent.stamp_realtime_ns - 30_000_000
    node.inbox.close()


def test_camera_without_calibration(tmp_path):
    config = CameraConfig.model_validate(
        {"source": {"kind": "folder", "folder": tmp_path}, "calibration": tmp_path / "no.yaml"}
    )
    with pytest.raises(CalibrationError, match="no such calibration"):
        CameraNode.build(config, context(tmp_path))


# VICON


@pytest.fixture
def vicon(tmp_path):
    node = ViconNode.build(ViconNodeConfig(port=0, subjects=("car", "board")), context(tmp_path))
    yield node
    node.close()
    node.inbox.close()


def send_pose(node, frame_number, name, T):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in encode_blocks(frame_number, [object_pose(name, T)]):
            sender.sendto(datagram, ("127.0.0.1", node.port))


def test_vicon_one_topic_for_each_subject(vicon):
    assert vicon.publications == ("/vicon/car", "/vicon/board")
    assert vicon.status() == ("starting", f"no datagrams on UDP port {vicon.port}")
    send_pose(vicon, 1, "car", planar_pose(0.5, -0.2, 0.7))
    (out,) = take(vicon)
    assert out.topic == "/vicon/car"
    np.testing.assert_allclose(pose_matrix(out.message), planar_pose(0.5, -0.2, 0.7), atol=1e-9)
    assert abs(ns_from_stamp(out.message.header.stamp) - CLOCK.now().real_ns) < 1e9
    assert vicon.status() == ("active", "not seen: board")


def test_vicon_that_loses_the_car_reports_a_fault(vicon):
    send_pose(vicon, 1, "car", planar_pose(0.5, -0.2, 0.7))
    take(vicon)
    send_pose(vicon, 2, "car", np.full((4, 4), np.nan))
    assert take(vicon, 0.6) == []
    assert vicon.status()[0] == "fault"
    assert vicon.counters()["lost car"] == 1


def test_vicon_subjects_need_topics():
    with pytest.raises(ValidationError, match="unknown topic '/vicon/lamp'"):
        ViconNodeConfig(subjects=("lamp",))


# Motor


class Drives:
    """A motor node on an emulator, and the safety node's commands to it."""

    def __init__(self, tmp_path, **vesc):
        self.emulator = VescEmulator(VescEmulatorConfig(**vesc), TwinVehicle(CarConfig()), tmp_path / "vesc")
        self.config = MotorConfig(port=str(tmp_path / "vesc"), calibration=TWIN / "vehicle.yaml")
        self.node = MotorNode.build(self.config, context(tmp_path))

    def send(self, speed, steering, stamp_ns=12_345):
        now = CLOCK.now()
        return self.node.handle(
            "/safety/drive",
            drive_message(speed, steering, stamp_ns),
            MessageInfo(now.mono_ns, now.mono_ns, instance_id=1),
            now,
        )

    def run(self, duration_s):
        outs, deadline = [], time.monotonic() + duration_s
        while time.monotonic() < deadline:
            outs += self.node.tick(CLOCK.now())
            time.sleep(0.02)
        return outs

    def names(self):
        return [e.name for e in self.emulator.events() if e.name not in ("GET_VALUES", "FW_VERSION", "GET_APPCONF")]


@pytest.fixture
def drives(tmp_path):
    drives = Drives(tmp_path)
    yield drives
    drives.node.close()
    drives.emulator.close()


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
    assert text == "TWIN firmware 5.02, own time-out 1000 ms with 0 A"


def test_motor_obeys_and_reports_the_origin(drives):
    drives.run(0.1)
    drives.send(0.0, 0.0)
    (out,) = drives.send(0.3, 0.1, stamp_ns=777)
    message = out.message
    assert ns_from_stamp(message.header.stamp) == 777
    assert not message.braking
    assert message.speed_mps == pytest.approx(0.3, abs=1e-3)
    assert abs(int(message.serial_write_mono_ns) - time.monotonic_ns()) < 1e9
    time.sleep(0.05)
    assert drives.names()[-2:] == ["SET_SERVO_POS", "SET_RPM"]
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
    drives.emulator = VescEmulator(VescEmulatorConfig(), TwinVehicle(CarConfig()), tmp_path / "vesc")
    drives.run(0.8)
    assert drives.send(0.5, 0.0) == []
    assert set(drives.names()) == {"SET_CURRENT_BRAKE"}
    drives.send(0.0, 0.0)
    assert drives.send(0.5, 0.0) != []


def test_motor_on_a_controller_that_is_silent(tmp_path):
    master, slave = pty.openpty()
    tty.setraw(slave)
    config = MotorConfig(port=os.ttyname(slave), calibration=TWIN / "vehicle.yaml")
    node = MotorNode.build(config, context(tmp_path))
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
    time.sleep(0.05)
    assert drives.names()[-2:] == ["SET_CURRENT_BRAKE", "SET_CURRENT"]


def test_vehicle_file_reaches_the_driver(tmp_path):
    car = load_calibration(VehicleCalibration, TWIN / "vehicle.yaml")
    vesc = Vesc("/dev/null", car.vehicle_gains, car.drive_limits)
    assert vesc.gains.erpm(0.8) == pytest.approx(3691.2)


# Safety


class Guard:
    """A safety node with a clock in milliseconds."""

    def __init__(self):
        limits = ArmingLimits(nodes=("camera", "motor"), fence_m=((-1, -1), (1, -1), (1, 1), (-1, 1)))
        self.node = SafetyNode(limits)
        self.ms = 1000

    @property
    def now(self):
        return Now(self.ms * 1_000_000, 10**18 + self.ms * 1_000_000)

    def say(self, topic, message):
        return self.node.handle(
            topic, message, MessageInfo(self.now.mono_ns, self.now.mono_ns, instance_id=1), self.now
        )

    def everything(self, peer="TWIN"):
        stamp = self.now.real_ns
        for name in ("camera", "motor"):
            status = types.NodeStatus(
                header=header(stamp), node=name, pid=1, state="ready", text="", subscriptions=[], publications=[],
                subscribers=np.zeros(0, np.uint32), counter_names=[], counter_values=np.zeros(0),
            )  # fmt: skip
            self.say(f"/status/{name}", status)
        sent = types.MotorSent(
            header=header(stamp), serial_write_mono_ns=0, serial_write_real_ns=0, speed_mps=0.0, steering_rad=0.0, erpm=0.0,
            servo=0.5, brake_current_a=0.0, braking=True, reason="", peer=peer,
        )  # fmt: skip
        self.say("/motor/sent", sent)
        info = types.CameraInfo(
            header=header(stamp), height=1, width=1, distortion_model="", d=np.zeros(5), k=np.zeros(9), r=np.zeros(9),
            p=np.zeros(12), binning_x=0, binning_y=0,
            roi=types.RegionOfInterest(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
        )  # fmt: skip
        self.say("/camera/camera_info", info)
        pose = types.Pose(
            position=types.Point(x=0.1, y=0.2, z=0.0), orientation=types.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
        )
        self.say("/vicon/car", types.PoseStamped(header=header(stamp), pose=pose))
        return self.say("/policy/drive", drive_message(0.8, 0.1, stamp))

    def arm(self, arm=True):
        self.ms += 1
        return self.say("/arm", types.Arm(header=header(0), arm=arm, source="trial", reason="test"))


def drives_of(outs):
    return [(o.message.drive.speed, o.message.drive.steering_angle) for o in outs if o.topic == "/safety/drive"]


def states_of(outs):
    return [o.message.armed for o in outs if o.topic == "/safety/state"]


def test_safety_says_stop_25_times_a_second_until_armed():
    guard, stops = Guard(), []
    for _ in range(50):
        guard.ms += 20
        stops += drives_of(guard.node.tick(guard.now))
    assert 20 <= len(stops) <= 26
    assert set(stops) == {(0.0, 0.0)}
    assert guard.node.status() == ("ready", "disarmed: nobody has armed")


def test_safety_passes_commands_with_their_stamp_only_while_armed():
    guard = Guard()
    assert drives_of(guard.everything()) == []
    assert states_of(guard.arm()) == [True]
    guard.ms += 50
    (out,) = guard.everything()
    assert out.message.drive.speed == pytest.approx(0.8)
    assert ns_from_stamp(out.message.header.stamp) == guard.now.real_ns
    assert drives_of(guard.node.tick(guard.now)) == []
    assert guard.node.status() == ("active", "armed by trial")
    outs = guard.arm(False)
    assert drives_of(outs) == [(0.0, 0.0)]
    assert states_of(outs) == [False]
    assert drives_of(guard.everything()) == []


def test_safety_says_stop_in_the_same_breath_as_it_finds_a_fault():
    guard = Guard()
    guard.everything()
    guard.arm()
    guard.ms += 20
    outs = guard.say("/policy/drive", drive_message(0.8, math.nan, guard.now.real_ns))
    assert drives_of(outs) == [(0.0, 0.0)]
    assert states_of(outs) == [False]


def test_safety_does_not_let_a_program_arm_a_real_car():
    guard = Guard()
    guard.everything(peer="60_MK5 firmware 5.02")
    assert states_of(guard.arm()) == []
    guard.ms += 120
    (state,) = [o.message for o in guard.node.tick(guard.now) if o.topic == "/safety/state"]
    assert "a real car is armed by source 'operator' only" in state.reason


def test_safety_reads_its_fence_from_the_room_file(tmp_path):
    node = SafetyNode.build(SafetyConfig(room=TWIN / "room.yaml", nodes=("camera",)), context(tmp_path))
    assert "/status/camera" in node.subscriptions
    assert "/status/policy" not in node.subscriptions
