"""Every motion of the car passes; what no car can do is caught: by drives of the twin's car, with noise, loss and late datagrams."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from advnerf_core.geometry import make_transform, planar_pose, rotation_x, rotation_z
from hardware.motor.limits import DriveLimits
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle
from nodes.control.pose_check import MotionBounds, PoseCheck, PoseGate
from nodes.runtime.wire import MessageInfo

pytestmark = pytest.mark.live

BOUNDS = MotionBounds.of_car(DriveLimits(), 0.25, 1.25, 0.005, 0.01)
CAR = CarConfig()


def poses_of_drive(rng, count, period_s=0.01):
    """Truth at the stream's rate: random commands inside the limits, held for a while."""
    car, limits = TwinVehicle(CAR), DriveLimits()
    for k in range(count):
        if k % 40 == 0:
            speed = rng.uniform(limits.speed_min_mps, limits.speed_max_mps)
            car.command(
                servo=CAR.servo_from_steering(rng.uniform(limits.steering_min_rad, limits.steering_max_rad))
            )
            if rng.random() < 0.2:
                car.command(brake_current_a=20.0)
            else:
                car.command(erpm=CAR.erpm_from_speed(speed))
        state = car.advance(period_s)
        yield planar_pose(state.x_m, state.y_m, state.yaw_rad)


def noisy(T, rng):
    """With 0.5 mm and 1 mrad on every axis."""
    roll, _, yaw = rng.normal(0.0, 1e-3, 3)
    return make_transform(T[:3, :3] @ rotation_x(roll) @ rotation_z(yaw), T[:3, 3] + rng.normal(0.0, 5e-4, 3))


def arrivals(rng, count, period_s, loss, hold_up_s):
    """Frames that arrive, each with its stamp: a computer or network that is held up brings all that waited at once."""
    free_s = 0.0
    for k in range(count):
        sent_s = k * period_s
        if rng.random() < 0.01:
            free_s = max(free_s, sent_s + rng.uniform(0.0, hold_up_s))
        if rng.random() >= loss:
            yield k, max(sent_s, free_s) + rng.exponential(2e-4)


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    rate_hz=st.sampled_from([25.0, 50.0, 100.0, 250.0]),
    loss=st.floats(0.0, 0.3),
    hold_up_s=st.floats(0.0, 0.08),
)
@example(
    seed=4952885, rate_hz=25.0, loss=0.0, hold_up_s=0.0625
)  # the first pose and the second arrive together
def test_no_drive_is_impossible_whatever_the_network_does(seed, rate_hz, loss, hold_up_s):
    rng, check = np.random.default_rng(seed), PoseCheck(BOUNDS)
    truth = list(poses_of_drive(rng, 600, 1.0 / rate_hz))
    last_s = 0.0
    for k, stamp_s in arrivals(rng, len(truth), 1.0 / rate_hz, loss, hold_up_s):
        last_s = max(last_s, stamp_s)
        assert check.judge(round(last_s * 1e9), noisy(truth[k], rng)) == "", (k, last_s)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    size_m=st.floats(0.05, 2.4),
    way_rad=st.floats(-math.pi, math.pi),
    loss=st.floats(0.0, 0.02),
)
def test_every_jump_is_caught_at_once(seed, size_m, way_rad, loss):
    rng, check = np.random.default_rng(seed), PoseCheck(BOUNDS)
    moment = int(rng.integers(50, 300))
    for k, T in enumerate(poses_of_drive(rng, moment + 1)):
        if k == moment:
            T = T.copy()
            T[:2, 3] += size_m * np.array([math.cos(way_rad), math.sin(way_rad)])
        elif rng.random() < loss and moment - k > 15:
            continue
        found = check.judge(k * 10_000_000, noisy(T, rng))
        assert bool(found) == (k == moment), found


@pytest.mark.parametrize("turn_rad", [-3.1, -0.1, 0.1, 0.5, 3.14])
def test_a_turn_on_the_spot_is_caught(turn_rad):
    check = PoseCheck(BOUNDS)
    for k in range(30):
        assert check.judge(k * 10_000_000, planar_pose(0.008 * k, 0.0, 0.0)) == ""
    assert "turned by" in check.judge(300_000_000, planar_pose(0.24, 0.0, turn_rad))


def test_a_car_that_slides_sideways_or_runs_away_in_small_steps_is_caught():
    for way in ([0.0, 0.007, 0.0], [0.02, 0.0, 0.0], [0.0, 0.0, 0.007]):
        check = PoseCheck(BOUNDS)
        found = [check.judge(k * 10_000_000, make_transform(np.eye(3), k * np.array(way))) for k in range(60)]
        assert found[1] == ""
        assert any(found[:30]), way


def test_bounds_follow_the_limits_of_the_car():
    slow = MotionBounds.of_car(DriveLimits(speed_min_mps=0.0, speed_max_mps=0.5), 0.5, 1.0, 0.005, 0.01)
    assert (slow.forward_mps, slow.backward_mps) == (0.5, pytest.approx(0.05))
    assert slow.turn_radps == pytest.approx(0.5 * math.tan(0.3135) / 0.5)
    assert slow.reach_m == 0.5


def test_after_a_gap_nothing_is_known_and_a_gap_allows_what_can_happen_in_it():
    check = PoseCheck(BOUNDS)
    check.judge(0, planar_pose(0.0, 0.0, 0.0))
    assert check.judge(10**9, planar_pose(2.0, 1.0, 2.0)) == ""  # occluded for a second
    assert check.judge(10**9 + 10_000_000, planar_pose(2.0, 1.0, 2.0)) == ""
    assert (
        check.judge(
            10**9 + 160_000_000, planar_pose(2.0 + 0.15 * math.cos(2.0), 1.0 + 0.15 * math.sin(2.0), 2.0)
        )
        == ""
    )
    assert "jumped" in check.judge(10**9 + 310_000_000, planar_pose(1.0, 1.0, 2.0))


def test_a_clock_that_goes_back():
    check = PoseCheck(BOUNDS)
    for k in range(30):
        check.judge(k * 10_000_000, planar_pose(0.008 * k, 0.0, 0.0))
    assert check.judge(270_000_000, planar_pose(0.24, 0.0, 0.0)) == ""  # a step of 30 ms
    assert "went back by" in check.judge(0, planar_pose(0.24, 0.0, 0.0))
    assert check.judge(10_000_000, planar_pose(0.24, 0.0, 0.0)) == ""


@settings(max_examples=50)
@given(
    stamps=st.lists(st.integers(-(10**10), 10**10), max_size=30),
    xs=st.lists(st.floats(), min_size=30, max_size=30),
)
def test_nothing_makes_the_check_fail(stamps, xs):
    check = PoseCheck(BOUNDS)
    for stamp_ns, x in zip(stamps, xs, strict=False):
        assert isinstance(check.judge(stamp_ns, planar_pose(x, 0.0, 0.0)), str)


def test_the_gate_asks_for_rest():
    gate = PoseGate(PoseCheck(BOUNDS), rest_s=0.5)
    gate.heard(0, planar_pose(0.0, 0.0, 0.0), MessageInfo(10**9, 10**9, instance_id=1))
    assert gate.problem(10**9) == ""
    gate.heard(10_000_000, planar_pose(1.0, 0.0, 0.0), MessageInfo(10**9, 10**9, instance_id=1))
    assert "jumped 1.000 m forward" in gate.problem(10**9 + 499_000_000)
    assert gate.problem(10**9 + 501_000_000) == ""
    assert gate.count == 1
