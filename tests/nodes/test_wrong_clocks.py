"""Clocks that are wrong, set, or stand still, and processes that do not run: the car stops, and can be armed again soon."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nodes.control.stamps import ClockWatch, stamp_problem
from nodes.runtime.clock import Now, SystemClock
from nodes.runtime.messages import camera_info_message, drive_message, pose_message, types
from tests.support.messages import filled
from tests.support.virtual_stack import MS, REAL_NS, S, VirtualStack, status_message, teleop_message

STEPS_S = (0.5, 5.0, 60.0, 3600.0)
SIGNED_S = [sign * step for step in STEPS_S for sign in (1.0, -1.0)]
# From the fault to the last command to move: the limits of age (0.25 s) and one turn of the loops.
STOP_NS = 350 * MS


@pytest.fixture
def stack(monkeypatch):
    return VirtualStack(monkeypatch).run(1000)


@pytest.fixture
def driving(stack):
    return drive(stack)


def drive(stack):
    since_ns = stack.arm().mono_ns
    stack.run(500)
    assert stack.armed, stack.reason
    assert stack.moves(since_ns)
    return stack


def assert_stops(stack, duration_ms=1000):
    since_ns = stack.mono_ns
    stack.run(duration_ms)
    assert not stack.armed
    assert not stack.moves(since_ns + STOP_NS)
    return stack.reason


def step(stack, who, step_s):
    if who == "host":
        stack.real_ns += round(step_s * S)
    else:
        stack.real_off_ns[who] = stack.real_off_ns.get(who, 0) + round(step_s * S)


@pytest.mark.parametrize("step_s", SIGNED_S)
@pytest.mark.parametrize("who", ["host", "camera", "vicon"])
def test_a_step_of_a_clock_stops_the_car_which_can_be_armed_within_5_s_of_a_right_clock(driving, who, step_s):
    step(driving, who, step_s)
    reason = assert_stops(driving)
    assert any(word in reason for word in ("clock was set", "its stamp is", "went back", "no command")), (
        reason
    )
    step(driving, who, -step_s)
    driving.run(4500)
    assert not driving.armed  # nothing arms by itself
    drive(driving)


@pytest.mark.parametrize("step_s", SIGNED_S)
def test_the_clock_of_this_host_may_stay_where_it_was_set(driving, step_s):
    """Camera, motion capture and policy read the same clock, so that all stamps follow it."""
    step(driving, "host", step_s)
    assert "the real-time clock was set by" in assert_stops(driving)
    drive(driving)


@pytest.mark.parametrize("step_s", SIGNED_S)
def test_a_step_of_the_clock_of_the_hand_lets_go(monkeypatch, step_s):
    stack = VirtualStack(monkeypatch, hold=True).run(1000)
    stack.hand = "autonomy"
    assert stack.run(500).armed, stack.reason
    step(stack, "teleop", step_s)
    assert "the teleop node's message does not count: its stamp is" in assert_stops(stack)
    step(stack, "teleop", -step_s)
    assert not stack.run(1000).armed  # the button is still held, and was not pressed anew
    stack.hand = "idle"
    stack.run(200)
    stack.hand = "autonomy"
    assert stack.run(500).armed, stack.reason


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["host", "camera", "vicon"]),
            st.sampled_from(SIGNED_S),
            st.integers(8, 60).map(lambda n: 20 * n),
        ),
        min_size=1,
        max_size=5,
    )
)
def test_after_any_steps_the_car_stands_and_can_be_armed_once_the_clocks_are_right(monkeypatch, steps):
    stack = drive(VirtualStack(monkeypatch).run(1000))
    for who, step_s, pause_ms in steps:
        step(stack, who, step_s)
        stack.run(pause_ms)
    stack.real_off_ns.clear()
    stack.run(4500)
    assert not stack.armed
    since_ns = stack.mono_ns
    assert not stack.moves(since_ns)
    drive(stack)


@pytest.mark.parametrize("ahead_s", [0.06, 0.5, 3600.0])
def test_one_command_from_the_future_does_not_lock_out_the_others(stack, ahead_s):
    stack.say("/policy/drive", drive_message(0.8, 0.0, stack.real_ns + round(ahead_s * S)), 5)
    drive(stack)
    stack.say("/policy/drive", drive_message(0.8, 0.0, stack.real_ns + round(ahead_s * S)), 5)
    assert f"its stamp is {ahead_s:.2f} s in the future; set the clocks" in assert_stops(stack)
    drive(stack)


def test_a_camera_that_repeats_one_image_is_no_clock_that_was_set(driving):
    """Its command is fresh by its publication for ever."""
    driving.silent.add("policy")
    stamp_ns = driving.real_ns - 50 * MS
    since_ns = driving.mono_ns + 1
    for _ in range(20):
        driving.say("/policy/drive", drive_message(0.8, 0.1, stamp_ns), 5)
        driving.run(100)
    assert not driving.armed
    assert not driving.moves(since_ns + STOP_NS)


def test_arming_says_what_is_wrong_with_the_commands(stack):
    stack.real_off_ns["camera"] = 3600 * S
    stack.run(500)
    stack.arm()
    expected = "no command from the policy for 0.5"
    assert expected in stack.reason
    assert "in the future; set the clocks (chrony))" in stack.reason


FUTURE = {
    "camera": ("/camera/camera_info", lambda s: camera_info(s), 4),
    "vicon": ("/vicon/car", lambda s: pose_message(standing(), s.real_ns), 3),
    "policy": ("/policy/drive", lambda s: drive_message(0.8, 0.0, s.real_ns - 40 * MS), 5),
}


def camera_info(stack):
    from advnerf_core.geometry import Pinhole

    return camera_info_message(Pinhole(30, 20, 9, 9, 15, 10), stack.real_ns, "camera")


def standing():
    from advnerf_core.geometry import planar_pose

    return planar_pose(-1.1, -2.0, 0.0)


@pytest.mark.parametrize("who", FUTURE)
def test_a_publication_in_the_future_is_not_fresh_for_ever(monkeypatch, who):
    stack = VirtualStack(monkeypatch, speed_mps=0.1).run(1000)
    stack.arm().run(500)
    assert stack.armed, stack.reason
    topic, make, instance = FUTURE[who]
    stack.silent.add(who)
    stack.say(topic, make(stack), instance, published_ns=stack.mono_ns + 3600 * S)
    assert_stops(stack, 1500)


def test_a_status_or_a_hand_from_the_future_is_not_fresh_for_ever(monkeypatch):
    stack = VirtualStack(monkeypatch, hold=True).run(1000)
    stack.hand = "autonomy"
    assert stack.run(500).armed
    stack.silent.add("teleop")
    future_ns = stack.mono_ns + 3600 * S
    stack.say("/teleop/state", teleop_message("autonomy", stack.real_ns), 6, future_ns)
    assert "no message from the teleop node" in assert_stops(stack)
    stack.silent = {"camera"}
    stack.say("/status/camera", status_message("camera", "active", "", stack.real_ns), 4, future_ns)
    stack.say("/camera/camera_info", camera_info(stack), 4, future_ns)
    stack.run(1500)
    stack.arm()
    assert "silent" in stack.reason or "no camera image" in stack.reason


def test_telemetry_from_the_future_is_not_fresh_for_ever(stack):
    telemetry = filled(
        types.VescState, header=camera_info(stack).header, input_voltage_v=15.0, mosfet_temperature_c=30.0
    )
    stack.silent.add("motor")
    stack.say("/motor/state", telemetry, 2, stack.mono_ns + 3600 * S)
    stack.run(300)
    stack.arm()
    assert "no telemetry from the motor node for 0.3" in stack.reason


@pytest.mark.parametrize("slept_s", [0.06, 1.0, 8 * 3600.0])
def test_a_suspend_disarms_and_latches_although_everything_looks_fresh(driving, slept_s):
    """Monotonic time stands still, and real time goes on: the first messages afterwards are those from before."""
    since_ns = driving.mono_ns + 1
    driving.asleep_ns += round(slept_s * S)
    driving.real_ns += round(slept_s * S)
    driving.motor.tick(driving.now)
    assert driving.motor.status() == ("fault", f"latched: the computer was suspended for {slept_s:.2f} s")
    driving.run(1000)
    assert f"the computer was suspended for {slept_s:.2f} s" in driving.reason
    assert not driving.armed
    assert not driving.moves(since_ns)  # from the first instant on
    drive(driving)


def test_a_suspend_of_which_only_the_boot_clock_tells(driving):
    driving.asleep_ns += 60 * MS
    since_ns = driving.mono_ns + 1
    driving.run(500)
    assert not driving.armed
    assert not driving.moves(since_ns)
    assert driving.reason == "the computer was suspended for 0.06 s"


def test_a_request_to_arm_from_before_a_suspend_is_void(stack):
    from nodes.runtime.arm_requests import arm_message
    from nodes.runtime.requests import RequestIdentity

    asked = RequestIdentity.at(stack.now)
    message = arm_message(asked, stack.now, True, "operator", "")
    stack.asleep_ns += 10 * S
    stack.real_ns += 10 * S
    stack.say("/arm", message, 7)
    stack.run(100)
    assert not stack.armed


def test_a_request_to_arm_from_the_future_does_not_count(stack):
    from nodes.runtime.arm_requests import arm_message
    from nodes.runtime.requests import RequestIdentity

    later = Now(stack.mono_ns, stack.real_ns + 60 * S)
    stack.say("/arm", arm_message(RequestIdentity.at(later), later, True, "operator", ""), 7)
    assert not stack.armed
    drive(stack)


@pytest.mark.parametrize("paused_ms", [240, 1000, 60_000])
def test_a_loop_that_did_not_run_disarms_and_latches(driving, paused_ms):
    """A freezer or a debugger stops every process. Afterwards the newest of everything is fresh again."""
    driving.wait(paused_ms)
    since_ns = driving.mono_ns + 1
    now_ns = driving.real_ns
    driving.say("/policy/drive", drive_message(0.8, 0.1, now_ns - 20 * MS), 5)
    driving.say("/safety/drive", drive_message(0.8, 0.1, now_ns - 20 * MS), 1)
    driving.run(1000)
    assert not driving.armed
    assert not driving.moves(since_ns)
    assert "held up" in driving.reason
    drive(driving)


def test_the_motor_node_alone_did_not_run(driving):
    gate = driving.motor._gate
    for _ in range(15):
        driving.wait(20)
    action = gate.tick(driving.mono_ns)
    assert "held up for 0.3" in gate.reason
    assert action.current_a > 0.0


def test_the_clocks_are_read_within_a_millisecond_of_each_other_or_not_compared():
    times = {
        "mono": iter([5 * S, 5 * S + MS, 6 * S, 6 * S + MS + 2]),
        "boot": 9 * S + MS // 2,
        "real": REAL_NS,
    }
    clock = SystemClock(lambda: next(times["mono"]), lambda: times["boot"], lambda: times["real"])
    assert clock.now() == Now(5 * S + MS, REAL_NS, 4 * S)
    assert clock.now() == Now(6 * S + MS + 2, REAL_NS, None)


def test_the_clocks_of_this_computer_differ_by_the_time_that_it_slept():
    first, second = SystemClock().now(), SystemClock().now()
    assert second.mono_ns >= first.mono_ns
    if first.asleep_ns is not None and second.asleep_ns is not None:
        assert abs(second.asleep_ns - first.asleep_ns) < 2 * MS
        assert ClockWatch().problem(second) == ""


def test_small_changes_of_the_boot_clock_add_up_and_slewing_does_not():
    watch, asleep, real = ClockWatch(), 0, 0
    found = []
    for k in range(1000):
        asleep += 100_000 if k < 600 else 0
        real += 20 * MS + 10_000  # half a millisecond a second
        found.append(watch.problem(Now(k * 20 * MS, real, asleep)))
    assert [text for text in found if text] == ["the computer was suspended for 0.05 s"]
    assert watch.problem(Now(1000 * 20 * MS, real + 20 * MS + 60 * MS, None)) == ""
    assert watch.problem(Now(1000 * 20 * MS, real + 20 * MS + 60 * MS, asleep)).startswith(
        "the real-time clock was set by +0.06"
    )


@pytest.mark.parametrize(
    ("age_s", "problem"),
    [(0.0, ""), (0.25, ""), (-0.05, ""), (0.26, "its stamp is 0.26 s old"), (-0.06, "0.06 s in the future")],
)
def test_stamps_of_a_moment_ago(age_s, problem):
    found = stamp_problem(age_s, 0.25)
    assert problem in found
    assert bool(problem) == bool(found)
