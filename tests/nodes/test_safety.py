"""The safety node in this process: when it says stop, and what it passes on."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from advnerf_core.geometry import planar_pose
from calibration.schema import RoomCalibration, VehicleCalibration, load_calibration
from nodes.control.arming import ArmingLimits
from nodes.motor import MotorConfig
from nodes.runtime.arm_requests import arm_message
from nodes.runtime.clock import Now
from nodes.runtime.errors import ConfigError
from nodes.runtime.messages import drive_message, header, ns_from_stamp, pose_message, types
from nodes.runtime.node import MessageInfo
from nodes.runtime.requests import RequestIdentity
from nodes.safety import SafetyConfig, SafetyNode
from tests.support.messages import filled

pytestmark = pytest.mark.live

TWIN = Path(__file__).parents[2] / "calibration" / "twin"


class Guard:
    """A safety node with a clock in milliseconds."""

    def __init__(self):
        limits = ArmingLimits(nodes=("camera", "motor"), fence_m=((-1, -1), (1, -1), (1, 1), (-1, 1)))
        config = SafetyConfig(room=TWIN / "room.yaml", vehicle=TWIN / "vehicle.yaml")
        car = load_calibration(VehicleCalibration, config.vehicle)
        self.node = SafetyNode(limits, config.poses(car), config.stall())
        self.ms, self.wheels = 1000, 0.0

    @property
    def now(self):
        return Now(self.ms * 1_000_000, 10**18 + self.ms * 1_000_000)

    def say(self, topic, message):
        return self.node.handle(
            topic,
            message,
            MessageInfo(self.now.mono_ns, self.now.mono_ns, publish_real_ns=self.now.real_ns, instance_id=1),
            self.now,
        )

    def everything(self, peer="TWIN firmware 5.02", speed=0.8):
        stamp = self.now.real_ns
        for name in ("camera", "motor"):
            status = filled(types.NodeStatus, header=header(stamp), node=name, pid=1, state="ready")
            self.say(f"/status/{name}", status)
        sent = filled(types.MotorSent, header=header(stamp), servo=0.5, braking=True, peer=peer)
        self.say("/motor/sent", sent)
        self.say("/motor/state", self.telemetry())
        info = filled(
            types.CameraInfo,
            header=header(stamp),
            height=1,
            width=1,
            d=np.zeros(5),
            roi=types.RegionOfInterest(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
        )
        self.say("/camera/camera_info", info)
        self.see_car()
        return self.say("/policy/drive", drive_message(speed, 0.1, stamp))

    def telemetry(self):
        return filled(
            types.VescState,
            header=header(self.now.real_ns),
            speed_mps=self.wheels,
            input_voltage_v=15.0,
            mosfet_temperature_c=30.0,
        )

    def see_car(self, x=0.1, y=0.2, yaw=0.0):
        return self.say("/vicon/car", pose_message(planar_pose(x, y, yaw), self.now.real_ns))

    def arm(self, arm=True):
        self.ms += 1
        return self.say("/arm", arm_message(RequestIdentity.at(self.now), self.now, arm, "trial", "test"))


def drives_of(outs):
    return [
        (o.message.drive.speed, o.message.drive.steering_angle) for o in outs if o.topic == "/safety/drive"
    ]


def states_of(outs):
    return [o.message.armed for o in outs if o.topic == "/safety/state"]


def test_safety_says_stop_25_times_a_second_until_armed():
    guard, stops = Guard(), []
    for _ in range(50):
        guard.ms += 20
        stops += drives_of(guard.node.tick(guard.now))
    assert 20 <= len(stops) <= 26
    assert set(stops) == {(0.0, 0.0)}
    assert guard.node.status() == ("ready", "disarmed: not armed since the start")


def test_safety_hears_from_its_counters_that_the_camera_plays_a_recording():
    guard = Guard()
    guard.everything()
    assert states_of(guard.arm()) == [True]
    played = filled(
        types.NodeStatus,
        header=header(guard.now.real_ns),
        node="camera",
        pid=1,
        state="active",
        counter_names=["frames_missed", "recorded"],
        counter_values=np.array([0.0, 1.0]),
    )
    guard.say("/status/camera", played)
    assert guard.node.status() == ("active", "armed by trial")
    guard.say(
        "/motor/sent",
        filled(types.MotorSent, header=header(guard.now.real_ns), servo=0.5, peer="60_MK6 5.02"),
    )
    state, text = guard.node.status()
    guard.node.tick(guard.now)
    state, text = guard.node.status()
    assert (state, text[:42]) == ("ready", "disarmed: node camera plays a recording, b")


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
    assert states_of(guard.arm()) == [False]
    guard.ms += 120
    (state,) = [o.message for o in guard.node.tick(guard.now) if o.topic == "/safety/state"]
    assert "expected source 'operator' for a real car" in state.reason


def test_safety_reads_its_fence_from_the_room_file(node_context):
    config = SafetyConfig(room=TWIN / "room.yaml", vehicle=TWIN / "vehicle.yaml", nodes=("camera",))
    node = SafetyNode.build(config, node_context)
    assert "/status/camera" in node.subscriptions
    assert "/status/policy" not in node.subscriptions


# Poses and stalls.


class Drive(Guard):
    """A guard whose world goes on by itself: a car that does what it is told, measured at 100 Hz."""

    def __init__(self):
        super().__init__()
        self.x, self.speed = -0.5, 0.0
        self.offset = (0.0, 0.0, 0.0)

    def run(self, seconds, command=0.5):
        for step in range(round(100 * seconds)):
            self.ms += 10
            self.x += 0.01 * self.speed
            self.see_car(self.x + self.offset[0], self.offset[1], self.offset[2])
            if step % 4 == 0:
                self.say("/motor/state", self.telemetry())
            if step % 2 == 0:
                self.everything_but_the_car(command)
                self.node.tick(self.now)
        return self

    def everything_but_the_car(self, command):
        self.see_car = lambda *pose: None
        try:
            self.everything(speed=command)
        finally:
            del self.see_car

    @property
    def reason(self):
        state, text = self.node.status()
        return "" if state == "active" else text


@pytest.fixture
def drive():
    drive = Drive().run(0.6, command=0.0)
    drive.arm()
    drive.run(0.3, command=0.0)
    assert drive.reason == ""
    return drive


@pytest.mark.parametrize(
    ("offset", "words"),
    [
        ((0.05, 0.0, 0.0), r"jumped 0.05\d m forward in 0.010 s; the car can move 0.02\d m"),
        ((-0.3, 0.0, 0.0), r"jumped 0.30\d m backward"),
        ((0.0, 0.05, 0.0), r"jumped 0.050 m sideways"),
        ((0.0, 0.0, 0.3), r"turned by 0.30 rad"),
    ],
)
def test_a_pose_that_no_car_can_reach_disarms_and_is_named(drive, offset, words):
    drive.offset = offset
    drive.run(0.01)
    assert re.search(words, drive.reason), drive.reason
    drive.run(1.0, command=0.0)
    drive.arm()
    assert drive.reason == ""  # where it is measured now, it stays


def test_a_car_that_is_carried_can_be_armed_once_it_rests(drive):
    drive.arm(False)
    for step in range(20):
        drive.offset = (0.02 * step, 0.03 * step, 0.1 * step)
        drive.run(0.01)
    drive.arm()
    assert "turned by" in drive.reason
    drive.run(0.6)
    drive.arm()
    assert drive.reason == ""


def test_a_message_that_is_no_pose_disarms(drive):
    message = pose_message(planar_pose(drive.x, 0.0, 0.0), drive.now.real_ns)
    message.pose.orientation = types.Quaternion(x=0.0, y=0.0, z=0.0, w=0.0)
    drive.say("/vicon/car", message)
    assert "expected a pose with an orientation" in drive.reason


@pytest.mark.parametrize(
    ("speed", "wheels", "words"),
    [
        (0.0, 0.0, "the car does not move"),
        (0.0, 0.5, "the wheels spin but the car does not move"),
        (0.5, 0.0, "the motor does not turn although the car moves"),
    ],
)
def test_a_stall_disarms_and_says_what_stands(drive, speed, wheels, words):
    drive.speed = drive.wheels = 0.5
    assert drive.run(0.5).reason == ""
    drive.speed, drive.wheels = speed, wheels
    assert drive.run(0.9).reason == ""
    drive.run(0.4)
    assert "s: commanded 0.50 m/s" in drive.reason
    assert words in drive.reason
    drive.speed = drive.wheels = 0.0
    drive.run(0.6, command=0.0)
    drive.arm()
    assert drive.reason == ""


def test_a_standing_start_and_slow_commands_are_no_stall(drive):
    assert drive.run(0.9).reason == ""  # it does not move yet
    drive.speed = drive.wheels = 0.5
    assert drive.run(1.5).reason == ""
    drive.speed = drive.wheels = 0.0
    assert drive.run(5.0, command=0.25).reason == ""


def test_a_stall_must_be_slower_than_its_command():
    with pytest.raises(ValidationError, match="every drive would be a stall"):
        SafetyConfig(room=TWIN / "room.yaml", vehicle=TWIN / "vehicle.yaml", stall_speed_mps=0.3)


@pytest.mark.parametrize(
    ("model", "key", "value", "said"),
    [
        (SafetyConfig, "max_steering_rad", 35.0, "at most 1.5708 rad, not degrees"),
        (SafetyConfig, "max_speed_mps", 100.0, "at most 50 m/s, not km/h or mm/s"),
        (SafetyConfig, "status_age_limit_s", 1000.0, "at most 5 s, not ms"),
        (SafetyConfig, "clock_error_limit_s", 100.0, "at most 5 s, not ms"),
        (SafetyConfig, "stall_command_mps", 300.0, "at most 50 m/s"),
        (SafetyConfig, "fence_margin_m", 100.0, "at most 20 m, not cm or mm"),
        (MotorConfig, "link_timeout_s", 200.0, "at most 5 s, not ms"),
        (MotorConfig, "controller_timeout_ms", 250_000, "less than or equal to 5000"),
    ],
)
def test_a_limit_in_another_unit_guards_nothing_and_is_refused(model, key, value, said):
    calibrations = {
        "room": TWIN / "room.yaml",
        "calibration": TWIN / "vehicle.yaml",
        "vehicle": TWIN / "vehicle.yaml",
    }
    needed = {name: file for name, file in calibrations.items() if name in model.model_fields}
    port = {"port": "/dev/vesc"} if model is MotorConfig else {}
    with pytest.raises(ValidationError, match=said):
        model(**needed, **port, **{key: value})


@pytest.mark.parametrize(("margin_m", "refused"), [(0.1, False), (1.49, False), (1.6, True), (10.0, True)])
def test_a_margin_by_which_the_start_of_the_room_is_outside_is_refused(margin_m, refused):
    """10 cm that were given as 10 m let no car be armed anywhere."""
    config = SafetyConfig(room=TWIN / "room.yaml", vehicle=TWIN / "vehicle.yaml", fence_margin_m=margin_m)
    room = load_calibration(RoomCalibration, config.room)
    if not refused:
        assert config.limits(room).fence_margin_m == margin_m
        return
    with pytest.raises(
        ConfigError, match=rf"fence_margin_m of at most 1\.50 m, .*got {margin_m:g} m .is it in cm"
    ):
        config.limits(room)
