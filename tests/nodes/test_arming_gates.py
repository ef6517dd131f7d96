"""Hold to run, priority of drivers, clocks of two hosts, the fence with its margin, the e-stop: each with its reason."""

import math
from itertools import pairwise

import numpy as np
import pytest

from calibration.fence import edge_distance_m, inside, require_simple
from nodes.control.arming import Arming, ArmingLimits
from nodes.control.arming_gates import ClockGate, HandGate
from nodes.runtime.clock import Now
from nodes.runtime.wire import MessageInfo

pytestmark = pytest.mark.live

MS = 1_000_000
REAL_NS = 1_700_000_000_000_000_000
L_SHAPE = ((-3.0, -3.0), (3.0, -3.0), (3.0, 0.0), (0.0, 0.0), (0.0, 3.0), (-3.0, 3.0))


class World:
    """An arming with everything well, an expert and a policy, and a hand on a button."""

    def __init__(self, hold=True, **limits):
        self.ms = 50_000
        limits = ArmingLimits(nodes=("camera",), fence_m=L_SHAPE, drivers=("expert", "policy"), **limits)
        self.arming = Arming(limits, HandGate(hold), ClockGate(peers=()))
        self.arming.peer = "60_MK5"  # a real car
        self.mode, self.estop, self.hand_speed = "idle", False, 0.4
        self.talking = {"expert", "policy", "teleop"}
        self.instances = {}
        self.xy = (-1.0, -1.0)
        self.passed = []

    def info(self, who):
        return MessageInfo(self.ms * MS, self.ms * MS, instance_id=self.instances.get(who, 1))

    def run(self, duration_ms):
        self.passed = []
        for _ in range(duration_ms // 10):
            self.ms += 10
            arming, mono_ns, real_ns = self.arming, self.ms * MS, REAL_NS + self.ms * MS
            arming.heard_car(*self.xy, self.info("vicon"))
            if self.ms % 50 == 0:
                arming.heard_camera(self.info("camera"))
                arming.heard_status("camera", "active", "", self.info("camera"))
                for who, speed in (("policy", 0.8), ("expert", 0.6)):
                    if who in self.talking and arming.heard_drive(
                        speed, 0.0, real_ns - 20 * MS, self.info(who), mono_ns, real_ns, who
                    ):
                        self.passed.append(who)
            if (
                self.ms % 50 == 20
                and "teleop" in self.talking
                and arming.heard_hand(
                    self.mode,
                    self.estop,
                    self.hand_speed,
                    0.1,
                    self.info("teleop"),
                    real_ns,
                    Now(mono_ns, real_ns),
                )
            ):
                self.passed.append("hand")
            arming.check(mono_ns)
        return arming.armed

    def hold(self, mode, duration_ms=300):
        self.mode = mode
        return self.run(duration_ms)

    def arm(self, source="operator"):
        self.ms += 1
        self.arming.arm(source, self.ms * MS, self.ms * MS)
        self.ms += 9
        return self.arming.armed


@pytest.fixture
def held():
    world = World()
    world.run(500)
    assert not world.arming.armed
    assert world.arming.problem(world.ms * MS) == "the button is not held"
    assert world.hold("autonomy")
    return world


def test_holding_arms_and_letting_go_stops(held):
    assert set(held.passed) == {"expert"}
    assert not held.hold("idle", 60)
    assert held.arming.reason == "the button is not held"
    assert held.passed == [] or held.passed[-1] != "hand"
    assert held.hold("autonomy")


def test_the_hand_goes_before_every_driver(held):
    held.hold("human")
    assert held.run(300)
    assert set(held.passed) == {"hand"}
    held.talking -= {"expert", "policy"}
    assert held.run(600)  # nobody else is needed while the hand drives
    assert not held.hold("autonomy", 100)
    assert "no command from the expert" in held.arming.reason


def test_silence_of_the_teleop_node_is_letting_go(held):
    held.talking.remove("teleop")
    start = held.ms
    while held.run(10):
        pass
    assert held.ms - start <= 260
    assert "no message from the teleop node for 0.2" in held.arming.reason
    held.talking.add("teleop")
    assert not held.run(1000)  # the button is still held: nothing arms by itself
    held.hold("idle")
    assert held.hold("autonomy")


def test_a_teleop_node_that_comes_back_with_the_button_held_arms_nothing(held):
    held.instances["teleop"] = 2
    assert not held.run(500)
    assert "release it first" in held.arming.reason
    assert not held.arm()
    held.hold("idle")
    assert held.hold("autonomy")


def test_after_a_fault_the_button_must_be_pressed_anew(held):
    held.xy = (1.0, 1.0)
    assert not held.run(50)
    held.xy = (-1.0, -1.0)
    assert not held.run(2000)
    held.hold("idle")
    assert held.hold("autonomy")


def test_the_estop_latches_until_a_person_re_arms(held):
    held.estop = True
    assert not held.run(100)
    assert "e-stop" in held.arming.reason
    assert not held.arm()  # still pressed
    held.estop = False
    held.hold("idle")
    assert not held.hold("autonomy")  # holding is not enough
    assert "e-stop" in held.arming.reason
    held.arming.peer = "TWIN firmware 5.02"
    assert not held.arm("trial")  # nor is a program, not even on the twin
    assert held.arm("operator")
    assert held.run(500)


@pytest.mark.parametrize(("speed", "word"), [(math.nan, "not finite"), (9.0, "9.00 m/s")])
def test_an_impossible_hand_stops(held, speed, word):
    held.hold("human")
    held.hand_speed = speed
    assert not held.run(60)
    assert word in held.arming.reason


def test_without_hold_to_run_the_estop_still_works():
    world = World(hold=False)
    world.run(300)
    assert world.arm()
    assert world.run(300)
    world.estop = True
    assert not world.run(60)


def test_the_expert_goes_before_the_policy_and_the_policy_never_stands_in_for_it():
    world = World(hold=False)
    world.talking = {"policy"}
    world.run(500)
    assert world.arm()
    world.run(300)
    assert set(world.passed) == {"policy"}
    world.talking.add("expert")
    assert world.run(300)
    assert world.passed[-3:] == ["expert"] * 3
    world.talking.remove("expert")
    assert not world.run(400)
    assert "no command from the expert for" in world.arming.reason
    assert "policy" not in world.passed
    assert world.arm()  # told so by a person, the policy drives on
    assert world.run(300)
    assert set(world.passed) == {"policy"}


@pytest.mark.parametrize(
    ("xy", "reason"),
    [
        ((-1.0, 2.0), ""),
        ((-0.15, 2.0), "0.15 m from the fence"),
        ((1.0, 1.0), "outside the fence"),
        ((-2.9, -1.0), "0.10 m from the fence"),
        ((math.nan, 0.0), "outside the fence"),
    ],
)
def test_a_fence_with_a_bay_and_a_margin(xy, reason):
    world = World(hold=False, fence_margin_m=0.2)
    world.run(300)
    assert world.arm()
    world.xy = xy
    assert world.run(100) is not bool(reason)
    assert reason in world.arming.reason


def test_edge_distance_against_dense_samples():
    corners = np.array([*L_SHAPE, L_SHAPE[0]])
    edge = np.concatenate([np.linspace(a, b, 2000) for a, b in pairwise(corners)])
    for point in np.random.default_rng(0).uniform(-4.0, 4.0, (60, 2)):
        brute = np.hypot(*(edge - point).T).min()
        assert edge_distance_m(tuple(point), L_SHAPE) == pytest.approx(brute, abs=4e-3)


def test_fences_whose_edges_cross_are_refused():
    require_simple(L_SHAPE)
    require_simple(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))
    with pytest.raises(ValueError, match=r"edges do not cross, but edge 1 .* crosses edge 3"):
        require_simple(((0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0)))
    assert not inside((1.0, 1.0), L_SHAPE)
    for corners in (((0.0, 0.0), (1.0, 1.0), (2.0, 2.0)), ((0.0, 0.0), (0.0, 5.0), (0.0, 1.0), (0.0, 3.0))):
        with pytest.raises(ValueError, match="on a line"):
            require_simple(corners)


def clock(offset_s, error_s=0.002, peers=()):
    gate = ClockGate(peers=peers)
    gate.heard("robot", offset_s, error_s, MessageInfo(0, 0, instance_id=1))
    return gate


@pytest.mark.parametrize(
    ("gate", "age_ms", "reason"),
    [
        (clock(0.004), 10, ""),
        (clock(-0.05), 10, "the clock of robot is off by -50 ms, the limit is 30 ms"),
        (clock(math.nan), 10, "off by nan ms"),
        (clock(0.0, 0.15), 10, "is only known to 150 ms"),
        (clock(0.0, peers=("workstation",)), 10, "the clock offset to workstation is not known yet"),
        (clock(0.0, peers=("robot",)), 4000, "last measured 4.0 s ago"),
        (clock(-0.05), 4000, ""),  # a host that left
    ],
)
def test_clocks(gate, age_ms, reason):
    problem = gate.problem(age_ms * MS)
    assert reason in problem
    assert bool(problem) is bool(reason)


def test_a_skewed_clock_refuses_to_arm_and_disarms():
    world = World(hold=False)
    world.arming.clocks.heard("robot", 0.05, 0.001, world.info("gateway"))
    world.run(300)
    assert not world.arm()
    assert world.arming.reason.startswith("not armed: the clock of robot is off by 50 ms")
    world.arming.clocks.heard("robot", 0.001, 0.001, world.info("gateway"))
    assert world.arm()
    world.arming.clocks.heard("robot", -0.2, 0.001, world.info("gateway"))
    assert not world.run(20)
