"""The gate before the motor controller: every way in which commands may cease, with time handed to it."""

import math
from pathlib import Path

import pytest

from nodes.control.arming import ArmingLimits
from nodes.control.command_gate import Brake, CommandGate, Drive, GateSettings, GateState
from nodes.control.stamps import AHEAD_LIMIT_S, COMMAND_AGE_S
from nodes.runtime.wire import MessageInfo

pytestmark = pytest.mark.live

SETTINGS = GateSettings(command_age_limit_s=0.22, brake_current_a=15.0, brake_ramp_s=0.1, brake_hold_s=1.0)
MS = 1_000_000
STOP = (0.0, 0.0)
GO = (0.8, 0.1)


class World:
    """A gate, a clock in milliseconds, and the safety node's side of the wire."""

    def __init__(self):
        self.ms = 10_000
        self.gate = CommandGate(SETTINGS, self.ms * MS)
        self.instance = 7

    def send(self, command, age_ms=0, stamp_age_s=0.0):
        """A command of a safety node that reports at the same time: disarmed with a stop, armed with any other."""
        self.report(command != STOP)
        info = MessageInfo((self.ms - age_ms) * MS, self.ms * MS, instance_id=self.instance)
        return self.gate.command(*command, info, self.ms * MS, stamp_age_s)

    def report(self, armed, instance=None):
        self.armed = armed
        info = MessageInfo(self.ms * MS, self.ms * MS, instance_id=instance or self.instance)
        self.gate.heard_safety(armed, info)

    def tick(self, after_ms=20):
        self.ms += after_ms
        return self.gate.tick(self.ms * MS)

    def let_pass(self, duration_ms):
        return [self.tick() for _ in range(duration_ms // 20)]


@pytest.fixture
def world():
    return World()


@pytest.fixture
def driving(world):
    world.send(STOP)
    assert world.send(GO) == Drive(*GO)
    return world


def test_it_starts_latched_and_brakes_a_car_that_rolls(world):
    assert world.send(GO) is None
    assert isinstance(world.tick(), Brake)
    assert world.tick().current_a > 0.0
    assert (world.gate.state, world.gate.refused) == (GateState.LATCHED, 1)


def test_an_explicit_stop_opens_it(world):
    assert world.send(STOP) is None
    assert world.gate.state is GateState.STOPPED
    assert world.send(GO) == Drive(0.8, 0.1)
    assert world.gate.state is GateState.DRIVING


@pytest.mark.parametrize("what", ["armed", "silent", "old", "another process"])
def test_a_stop_opens_it_only_while_the_safety_node_reports_disarmed(world, what):
    """A policy that commands zero speed while the car is armed must not open the latch."""
    if what == "old":
        world.report(armed=False)
        world.ms += 501
    elif what != "silent":
        world.report(armed=what == "armed", instance=8 if what == "another process" else None)
    info = MessageInfo(world.ms * MS, world.ms * MS, instance_id=world.instance)
    assert world.gate.command(*STOP, info, world.ms * MS) is None
    assert (world.gate.state, world.gate.refused) == (GateState.LATCHED, 1)
    assert world.send(GO) is None
    world.send(STOP)
    assert world.send(GO) == Drive(*GO)


def test_zero_speed_while_armed_stops_a_car_that_drives_and_does_not_latch(driving):
    info = MessageInfo(driving.ms * MS, driving.ms * MS, instance_id=driving.instance)
    assert isinstance(driving.gate.command(*STOP, info, driving.ms * MS), Brake)
    assert driving.gate.state is GateState.STOPPED
    assert driving.send(GO) == Drive(*GO)


@pytest.mark.parametrize("stamp_age_s", [0.51, 3600.0, -0.06, -3600.0])
def test_a_command_with_a_stamp_of_another_time_does_not_drive(driving, stamp_age_s):
    assert driving.send(GO, stamp_age_s=stamp_age_s) is None
    for _ in range(12):
        driving.ms += 20
        assert driving.send(GO, stamp_age_s=stamp_age_s) is None
    assert driving.gate.state is GateState.LATCHED
    assert isinstance(driving.send(STOP, stamp_age_s=stamp_age_s), Brake | None)
    assert driving.gate.state is GateState.STOPPED  # a stop of any time counts


def test_a_command_from_the_future_is_not_fresh_for_ever(driving):
    driving.send(GO, age_ms=-3_600_000)
    driving.let_pass(240)
    assert driving.gate.state is GateState.LATCHED


def test_a_pause_of_the_loop_latches(driving):
    driving.tick(230)
    assert driving.gate.reason == "the motor node was held up for 0.23 s"
    assert driving.send(GO) is None


def test_silence_brakes_in_time_then_lets_go_and_latches(driving):
    actions = driving.let_pass(2000)
    first_brake = next(i for i, a in enumerate(actions) if isinstance(a, Brake))
    assert 220 <= (first_brake + 1) * 20 <= 240
    assert all(a == Drive(*GO) for a in actions[:first_brake])
    currents = [a.current_a for a in actions[first_brake:] if a is not None]
    assert currents[0] == pytest.approx(5.0)
    assert max(currents) == 15.0
    braking = [c for c in currents if c > 0.0]
    assert braking == sorted(braking)  # a ramp, then held
    assert len(braking) * 20 == pytest.approx(1000, abs=40)
    assert currents[-1] == 0.0
    assert driving.gate.state is GateState.LATCHED
    assert "no fresh command" in driving.gate.reason


def test_after_silence_nothing_moves_until_a_stop_was_seen(driving):
    driving.let_pass(300)
    assert driving.send(GO) is None
    assert driving.send(GO) is None
    driving.send(STOP)
    assert driving.send(GO) == Drive(*GO)


@pytest.mark.parametrize("age_ms", [221, 1000, 60_000])
def test_old_commands_are_no_commands(driving, age_ms):
    driving.let_pass(200)
    assert driving.send(GO, age_ms=age_ms) is None
    assert isinstance(driving.tick(40), Brake)


def test_waking_up_after_being_stopped_by_a_signal_does_not_drive_on(driving):
    # SIGSTOP for 3 s; the first thing in the queue on waking is a fresh command.
    driving.ms += 3000
    assert driving.send(GO) is None
    assert driving.gate.state is GateState.LATCHED
    assert isinstance(driving.tick(), Brake)


def test_a_restarted_safety_node_must_say_stop_first(driving):
    driving.ms += 50
    driving.instance = 8
    assert driving.send(GO) is None
    assert "restarted" in driving.gate.reason
    driving.send(STOP)
    assert driving.send(GO) == Drive(*GO)


@pytest.mark.parametrize("command", [(math.nan, 0.0), (0.8, math.inf), (-math.inf, 0.0)])
def test_not_finite_brakes_at_once_and_latches(driving, command):
    assert isinstance(driving.send(command), Brake)
    assert driving.send(GO) is None


def test_told_to_stop_brakes_at_once_and_only_once_per_stop(driving):
    driving.ms += 30
    assert driving.send(STOP) == Brake(pytest.approx(5.0))
    for _ in range(40):
        driving.tick()
        driving.send(STOP)
    assert isinstance(driving.tick(), Brake)
    for _ in range(20):
        driving.tick()
        driving.send(STOP)
    released = [a for a in (driving.tick() for _ in range(10)) if a is not None]
    assert set(released) == {Brake(0.0)}


def test_stops_that_cease_latch_too(world):
    world.send(STOP)
    world.let_pass(300)
    assert world.gate.state is GateState.LATCHED
    assert world.send(GO) is None


def test_letting_go_is_repeated_ten_times_a_second_not_more(world):
    world.let_pass(1100)
    assert 9 <= sum(a is not None for a in world.let_pass(1000)) <= 11


def test_link_fault_latches(driving):
    driving.gate.latch("link fault", driving.ms * MS)
    assert driving.send(GO) is None
    driving.let_pass(2000)
    driving.gate.brake_again(driving.ms * MS)
    assert driving.tick().current_a > 0.0


def test_the_page_names_the_ages_at_which_safety_and_motor_refuse_a_command():
    page = (Path(__file__).parents[2] / "docs" / "cars.md").read_text(encoding="utf-8")
    (row,) = [line for line in page.splitlines() if line.startswith("| command from an old image")]
    safety_s, motor_s = ArmingLimits.image_age_s, COMMAND_AGE_S
    assert f"{safety_s:g} s old, then {motor_s:g} s; {AHEAD_LIMIT_S:g} s ahead" in row
