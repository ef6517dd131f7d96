"""The arming state machine: every check alone, every cause of a stop, and that nothing arms by itself."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.fence import inside
from nodes.control.arming import Arming, ArmingLimits
from nodes.runtime.wire import MessageInfo

pytestmark = pytest.mark.live

MS = 1_000_000
REAL_NS = 1_700_000_000_000_000_000
NODES = ("camera", "vicon", "compositor", "policy", "motor")
FENCE = ((-3.5, -3.5), (3.5, -3.5), (3.5, 3.5), (-3.5, 3.5))


class World:
    """An arming, a clock in milliseconds, and nodes that talk to it at their rates until they are silenced."""

    def __init__(self):
        self.ms = 50_000
        self.arming = Arming(ArmingLimits(nodes=NODES, fence_m=FENCE))
        self.arming.peer = "TWIN firmware 5.02"
        self.instances = {}
        self.silent = set()
        self.states = dict.fromkeys(NODES, "active")
        self.texts = {}
        self.recorded = False
        self.xy = (0.0, 0.0)
        self.command = (0.8, 0.1)
        self.capture_frozen_at = None
        self.passed = []

    def info(self, source, age_ms=0):
        return MessageInfo((self.ms - age_ms) * MS, self.ms * MS, instance_id=self.instances.get(source, 1))

    def real_ns(self):
        return REAL_NS + self.ms * MS

    def drive(self, capture_age_ms=50):
        capture = (self.capture_frozen_at or self.ms) * MS + REAL_NS - capture_age_ms * MS
        passed = self.arming.heard_drive(
            *self.command, capture, self.info("policy"), self.ms * MS, self.real_ns()
        )
        self.passed.append(passed)
        return passed

    def run(self, duration_ms):
        for _ in range(duration_ms // 10):
            self.ms += 10
            if self.ms % 100 == 0 and "camera" not in self.silent:
                self.arming.heard_camera(self.info("camera"))
            if self.ms % 100 == 50 and "policy" not in self.silent:
                self.drive()
            if "vicon" not in self.silent:
                self.arming.heard_car(*self.xy, self.info("vicon"))
            if self.ms % 200 == 0:
                for name in NODES:
                    if name not in self.silent:
                        recorded = self.recorded and name == "camera"
                        self.arming.heard_status(
                            name, self.states[name], self.texts.get(name, "text"), self.info(name), recorded
                        )
            if self.ms % 40 == 0 and "motor" not in self.silent:
                self.arming.heard_motor(self.info("motor"))
            if self.ms % 20 == 0:
                self.arming.check(self.ms * MS)
        return self.arming.armed

    def arm(self, source="operator", age_ms=0):
        self.ms += 1
        self.refusal = self.arming.arm(source, (self.ms - age_ms) * MS, self.ms * MS)
        self.ms += 9
        return self.arming.armed


@pytest.fixture
def world():
    world = World()
    world.run(1000)
    return world


@pytest.fixture
def armed(world):
    assert world.arm()
    assert world.run(1000)
    assert all(world.passed[-9:])
    return world


def time_to_disarm(world, limit_ms=3000):
    start = world.ms
    while world.arming.armed and world.ms - start < limit_ms:
        world.run(10)
    return world.ms - start


def test_a_camera_that_plays_a_recording_drives_the_simulated_car_alone(world):
    """Its frames are stamped when they are delivered, so that no age gives them away."""
    world.recorded = True
    world.run(500)
    assert world.arm()
    world.arming.peer = "60_MK6 firmware 5.02"
    assert time_to_disarm(world) <= 20
    said = "node camera plays a recording, by which the simulated car alone may drive; the motor's peer is 60_MK6 firmware 5.02, not the twin"
    assert world.arming.reason == said
    assert not world.arm()
    assert world.refusal == said
    world.recorded = False
    world.run(500)
    assert world.arm()


def test_nothing_passes_before_somebody_arms(world):
    assert not any(world.passed)
    assert world.arming.reason == "not armed since the start"


def test_all_is_well_for_a_minute(armed):
    assert armed.run(60_000)
    assert all(armed.passed[-500:])


@pytest.mark.parametrize(
    ("silent", "word", "limit_ms"),
    [
        ("camera", "no camera image", 260),
        ("vicon", "no pose of the car", 220),
        ("policy", "no command from the policy", 240),
        ("compositor", "node compositor has been silent", 1250),
        ("motor", "no telemetry from the motor node", 240),
    ],
)
def test_a_source_that_falls_silent(armed, silent, word, limit_ms):
    armed.silent.add(silent)
    assert time_to_disarm(armed) <= limit_ms + 20
    assert word in armed.arming.reason
    armed.silent.clear()
    assert not armed.run(5000)
    assert not armed.passed[-1]
    assert armed.arm()
    assert armed.run(1000)


@pytest.mark.parametrize("restarted", ["camera", "vicon", "policy", "compositor", "motor"])
def test_a_source_that_was_restarted_without_a_gap(armed, restarted):
    armed.instances[restarted] = 2
    assert time_to_disarm(armed) <= 220
    assert "restarted" in armed.arming.reason
    assert not armed.run(2000)
    assert armed.arm()
    assert armed.run(1000)


@pytest.mark.parametrize("state", ["fault", "starting"])
def test_a_node_that_reports_a_fault(armed, state):
    armed.states["motor"] = state
    assert time_to_disarm(armed) <= 220
    assert f"node motor is in state {state}: text" in armed.arming.reason
    assert not armed.arm()
    assert armed.arming.reason.startswith("not armed: node motor")


def test_leaving_the_fence(armed):
    armed.xy = (3.51, 0.0)
    assert time_to_disarm(armed) <= 30
    assert "outside the fence, at (3.51, 0.00) m" in armed.arming.reason
    assert not armed.arm()


@pytest.mark.parametrize(
    ("command", "word"),
    [
        ((math.nan, 0.0), "not finite"),
        ((0.8, -math.inf), "not finite"),
        ((1.2, 0.0), "1.20 m/s"),
        ((-1.2, 0.0), "-1.20 m/s"),
        ((0.8, 0.7), "0.70 rad"),
    ],
)
def test_impossible_commands(armed, command, word):
    armed.command = command
    assert time_to_disarm(armed) <= 110
    assert word in armed.arming.reason
    assert not armed.passed[-1]


def test_a_command_from_an_old_image(armed):
    assert not armed.drive(capture_age_ms=300)
    assert "its stamp is 0.30 s old, the limit is 0.25 s" in armed.arming.reason


def test_a_stamp_that_goes_back_while_armed_disarms(armed):
    assert armed.drive(capture_age_ms=10)
    armed.ms += 10
    assert not armed.drive(capture_age_ms=140)
    assert armed.arming.reason == "the stamps of the policy's commands went back by 0.12 s"
    armed.ms += 10
    assert not armed.drive(capture_age_ms=140)  # while disarmed, the comparison starts again
    assert armed.arm()
    assert armed.run(500)


def test_a_command_that_is_repeated_with_its_stamp_does_not_pass_again(armed):
    armed.ms += 1
    assert armed.drive(capture_age_ms=10)
    armed.ms += 1
    assert not armed.drive(capture_age_ms=11)
    assert armed.arming.armed


def test_a_camera_that_repeats_one_frame_for_ever(armed):
    armed.capture_frozen_at = armed.ms
    assert time_to_disarm(armed) <= 340
    assert not armed.passed[-1]


def test_being_held_up_disarms_before_anything_passes(armed):
    armed.ms += 3000  # SIGSTOP, SIGCONT; the newest of everything is fresh
    assert not armed.drive()
    assert "held up for 3.0" in armed.arming.reason
    assert not armed.run(2000)


def test_a_request_to_arm_from_before_the_stop_is_void(armed):
    armed.ms += 3000
    assert not armed.arm(age_ms=500)
    assert "older than the last stop (the safety node was held up" in armed.refusal
    assert "held up" in armed.arming.reason


def test_an_old_request_to_arm_is_void(world):
    assert not world.arm(age_ms=1500)
    assert world.refusal == "the request is older than the last stop (not armed since the start); arm again"
    world.run(2000)
    assert not world.arm(age_ms=1100)
    assert world.refusal == "the request is 1.1 s old, the limit is 1 s; arm again"


def test_disarming_is_at_once_and_latches(armed):
    armed.arming.disarm("disarmed by operator: enough", armed.ms * MS)
    assert not armed.drive()
    assert not armed.run(1000)


@pytest.mark.parametrize(
    ("peer", "allowed"),
    [
        ("TWIN firmware 5.02", True),
        ("60_MK5 firmware 5.02", False),
        ("", False),
        ("TWIN", False),
        ("TWINKLE firmware 5.02", False),
        ("my TWIN firmware 5.02", False),
        ("TWIN firmware 5.02, not the twin of this run", False),
    ],
)
def test_a_program_arms_only_the_twin(world, peer, allowed):
    world.arming.peer = peer
    assert world.arm(source="trial") is allowed
    if not allowed:
        assert "got 'trial'; the motor's peer is" in world.arming.reason
        assert world.arm(source="operator")


@settings(max_examples=60)
@given(
    st.lists(
        st.sampled_from(["camera", "vicon", "policy", "compositor", "motor", "talk", "pause", "run"]),
        max_size=12,
    )
)
def test_without_a_request_to_arm_no_history_ever_arms(events):
    world = World()
    for event in events:
        if event == "talk":
            world.silent.clear()
        elif event == "pause":
            world.ms += 400
        elif event == "run":
            world.run(300)
        else:
            world.silent.add(event)
        world.run(100)
        assert not world.arming.armed
    assert not any(world.passed)


def test_inside_of_polygons():
    corner = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (2.0, 4.0), (2.0, 2.0), (0.0, 2.0))
    assert inside((1.0, 1.0), corner)
    assert inside((3.0, 3.0), corner)
    assert not inside((1.0, 3.0), corner)
    assert not inside((5.0, 1.0), corner)
    assert not inside((math.nan, 1.0), corner)
