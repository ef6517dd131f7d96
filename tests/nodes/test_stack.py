"""The live stack as real processes on the twin: what the VESC reads when a process dies, hangs, or wakes up again."""

import signal

import pytest

from tests.support.stack import Stack

pytestmark = pytest.mark.live

MOVES = {"SET_RPM"}
BRAKES = {"SET_CURRENT_BRAKE"}


def victims(quick):
    """All of them; those but one only with the slow tests, because each takes seconds of real time."""
    names = ("camera", "vicon", "compositor", "policy", "safety")
    return [name if name == quick else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    stack = Stack(tmp_path_factory.mktemp("run"))
    try:
        stack.start()
        yield stack
    finally:
        stack.close()


def assert_stopped(stack, since_ns, limit_ms=350.0):
    """Brake within the limit, no motion afterwards, and zero current in the end."""
    events = stack.commands_after(since_ns)
    first = next(e for e in events if e.name in BRAKES)
    assert (first.mono_ns - since_ns) / 1e6 <= limit_ms
    after = [e for e in events if e.mono_ns >= first.mono_ns]
    assert not [e for e in after if e.name in MOVES]
    assert after[-1].name == "SET_CURRENT"
    assert after[-1].value == 0.0
    released = next(e for e in after if e.name == "SET_CURRENT")
    assert 0.8 <= (released.mono_ns - first.mono_ns) / 1e9 <= 1.4


def test_drive_reports_and_latency(stack):
    stack.wait_ready()
    stack.put_back()
    stack.sent.clear()
    stack.drive(1.5)
    driving = [m for m in stack.sent if not m.braking]
    assert len(driving) >= 12
    latencies = [
        m.serial_write_real_ns - (m.header.stamp.sec * 10**9 + m.header.stamp.nanosec) for m in driving
    ]
    assert min(latencies) > 0
    assert sorted(latencies)[len(latencies) // 2] < 100e6
    assert driving[-1].speed_mps == pytest.approx(0.8, abs=0.01)
    assert "TWIN" in driving[-1].peer
    assert stack.seen["/motor/state"].speed_mps == pytest.approx(0.8, abs=0.1)
    assert stack.seen["/vicon/car"].pose.position.x > -0.5
    stack.say_arm(False)
    stack.wait_until(lambda: not stack.armed, 5.0, "to be disarmed")
    stack.watch(1.5)
    assert stack.seen["/safety/state"].reason == "disarmed by trial: test"
    assert stack.commands_after(0)[-1].name == "SET_CURRENT"


@pytest.mark.parametrize("victim", victims(quick="safety"))
def test_a_process_that_hangs_stops_the_car_and_waking_up_does_not_move_it(stack, victim):
    stack.wait_ready()
    stack.put_back()
    stack.drive()
    since_ns = stack.signal(victim, signal.SIGSTOP)
    stack.watch(2.4)
    assert_stopped(stack, since_ns)
    stack.signal(victim, signal.SIGCONT)
    stack.watch(1.0)
    assert_stopped(stack, since_ns)
    assert not stack.armed


@pytest.mark.parametrize("victim", victims(quick="camera"))
def test_a_process_that_is_killed_stops_the_car_and_its_successor_does_not_move_it(stack, victim):
    stack.wait_ready()
    stack.put_back()
    stack.drive()
    since_ns = stack.signal(victim, signal.SIGKILL)
    stack.processes[victim].wait()
    stack.seen.pop(f"/status/{victim}", None)
    stack.start(victim)
    stack.wait_ready()
    stack.watch(1.2)
    assert_stopped(stack, since_ns)
    assert not stack.armed
    stack.drive(0.8)
    stack.say_arm(False)
    stack.wait_until(lambda: not stack.armed, 5.0, "to be disarmed")


@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.slow)])
def test_the_controller_itself_brakes_when_the_motor_node_is_gone(stack, number):
    stack.wait_ready()
    stack.put_back()
    stack.drive()
    since_ns = stack.signal("motor", number)
    stack.watch(1.5)
    events = stack.commands_after(since_ns)
    timeout = next(e for e in events if e.name == "TIMEOUT")
    assert timeout.value == 20.0
    assert (timeout.mono_ns - since_ns) / 1e6 <= 300.0
    assert not stack.armed
    if number == signal.SIGKILL:
        stack.processes["motor"].wait()
        stack.seen.pop("/status/motor", None)
        stack.start("motor")
    else:
        stack.signal("motor", signal.SIGCONT)
    stack.wait_ready()
    stack.watch(1.0)
    assert not [e for e in stack.commands_after(timeout.mono_ns) if e.name in MOVES]
    stack.drive(0.5)
    stack.say_arm(False)
    stack.wait_until(lambda: not stack.armed, 5.0, "to be disarmed")
