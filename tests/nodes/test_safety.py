"""The safety node in this process: when it says stop, and what it passes on."""

import math
from pathlib import Path

import numpy as np
import pytest

from nodes.arming import ArmingLimits
from nodes.runtime.arm_requests import arm_message
from nodes.runtime.clock import Now
from nodes.runtime.messages import drive_message, header, ns_from_stamp, types
from nodes.runtime.node import MessageInfo
from nodes.runtime.requests import Asked
from nodes.safety import SafetyConfig, SafetyNode

TWIN = Path(__file__).parents[2] / "calibration" / "twin"


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
            topic,
            message,
            MessageInfo(self.now.mono_ns, self.now.mono_ns, publish_real_ns=self.now.real_ns, instance_id=1),
            self.now,
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
        return self.say("/arm", arm_message(Asked.at(self.now), self.now, arm, "trial", "test"))


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
    assert states_of(guard.arm()) == [False]
    guard.ms += 120
    (state,) = [o.message for o in guard.node.tick(guard.now) if o.topic == "/safety/state"]
    assert "a real car is armed by source 'operator' only" in state.reason


def test_safety_reads_its_fence_from_the_room_file(node_context):
    node = SafetyNode.build(SafetyConfig(room=TWIN / "room.yaml", nodes=("camera",)), node_context)
    assert "/status/camera" in node.subscriptions
    assert "/status/policy" not in node.subscriptions
