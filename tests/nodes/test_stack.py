"""The live stack as real processes on the twin: what the VESC reads when a process dies, hangs, or wakes up again."""

import signal

import pytest

from tests.support.stack import Stack

pytestmark = pytest.mark.live

MOVES = "SET_RPM"
VICTIMS = ("camera", "vicon", "compositor", "policy", "safety")
LIMIT_MS, OWN_LIMIT_MS = 350.0, 300.0


def each(quick, names):
    """One of them by default, whatever the time it takes; all of them held to the clock."""
    timed = (pytest.param(name, True, id=f"{name} in time", marks=pytest.mark.timing) for name in names)
    return pytest.mark.parametrize(("victim", "timed"), [pytest.param(quick, False, id=str(quick)), *timed])


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    stack = Stack(tmp_path_factory.mktemp("run"))
    try:
        stack.start()
        yield stack
    finally:
        stack.close()


def assert_stopped(stack, since_ns, timed):
    """Brake, no motion afterwards, and zero current in the end; if timed, brake and release when they should be."""
    stop = stack.stopped(since_ns)
    stack.watch(1.0)
    after = stack.commands_after(stop[0].mono_ns)
    assert not [event for event in after if event.name == MOVES]
    assert (after[-1].name, after[-1].value) == ("SET_CURRENT", 0.0)
    if timed:
        assert (stop[0].mono_ns - since_ns) / 1e6 <= LIMIT_MS
        released = next(event for event in after if event.name == "SET_CURRENT")
        assert 0.8 <= (released.mono_ns - stop[0].mono_ns) / 1e9 <= 1.4


@pytest.mark.parametrize("timed", [False, pytest.param(True, id="in time", marks=pytest.mark.timing)])
def test_drive_reports_and_latency(stack, timed):
    stack.sent.clear()
    stack.drive(1.5)
    driving = [m for m in stack.sent if not m.braking]
    latencies = [
        m.serial_write_real_ns - (m.header.stamp.sec * 10**9 + m.header.stamp.nanosec) for m in driving
    ]
    assert min(latencies) > 0
    if timed:
        assert len(driving) >= 12
        assert sorted(latencies)[len(latencies) // 2] < 100e6
    assert driving[-1].speed_mps == pytest.approx(0.8, abs=0.01)
    assert "TWIN" in driving[-1].peer
    assert stack.seen["/motor/state"].speed_mps == pytest.approx(0.8, abs=0.1)
    assert stack.seen["/vicon/car"].pose.position.x > -0.5
    stack.disarm()
    assert stack.commands_after(0)[-1].value == 0.0


@each("safety", VICTIMS)
def test_a_process_that_hangs_stops_the_car_and_waking_up_does_not_move_it(stack, victim, timed):
    stack.drive()
    since_ns = stack.signal(victim, signal.SIGSTOP)
    assert_stopped(stack, since_ns, timed)
    stack.signal(victim, signal.SIGCONT)
    stack.watch(1.0)
    assert_stopped(stack, since_ns, timed)
    assert not stack.armed


@each("camera", VICTIMS)
def test_a_process_that_is_killed_stops_the_car_and_its_successor_does_not_move_it(stack, victim, timed):
    stack.drive()
    since_ns = stack.signal(victim, signal.SIGKILL)
    stack.processes[victim].wait()
    stack.seen.pop(f"/status/{victim}", None)
    stack.start(victim)
    stack.wait_ready()
    assert_stopped(stack, since_ns, timed)
    assert not stack.armed
    stack.drive(0.8)
    stack.disarm()


@each(signal.SIGKILL, (signal.SIGKILL, signal.SIGSTOP))
def test_the_controller_itself_brakes_when_the_motor_node_is_gone(stack, victim, timed):
    stack.drive()
    since_ns = stack.signal("motor", victim)

    def timeout():
        return next((event for event in stack.commands_after(since_ns) if event.name == "TIMEOUT"), None)

    stack.wait_until(timeout, 60.0, "for the controller's own time-out")
    assert timeout().value == 20.0
    assert not timed or (timeout().mono_ns - since_ns) / 1e6 <= OWN_LIMIT_MS
    stack.wait_until(lambda: not stack.armed, 60.0, "to be disarmed")
    if victim == signal.SIGKILL:
        stack.processes["motor"].wait()
        stack.seen.pop("/status/motor", None)
        stack.start("motor")
    else:
        stack.signal("motor", signal.SIGCONT)
    stack.wait_ready()
    stack.watch(1.0)
    assert not [e for e in stack.commands_after(timeout().mono_ns) if e.name == MOVES]
    stack.drive(0.5)
    stack.disarm()
