"""Limits: what leaves the computer, whatever was asked."""

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hardware.motor.limits import DriveLimiter, DriveLimits, VehicleGains

pytestmark = pytest.mark.live

LIMITS = DriveLimits()


def test_nominal_map_of_the_racecar():
    gains = VehicleGains()
    assert gains.erpm(0.8) == pytest.approx(3691.2)
    assert gains.servo(0.0) == pytest.approx(0.5304)
    assert gains.servo(0.2) == pytest.approx(0.2877)  # left is the smaller value
    assert gains.steering_rad(0.15) == pytest.approx(0.3135, abs=1e-4)
    assert gains.steering_rad(0.85) == pytest.approx(-0.2634, abs=1e-4)
    assert (gains.servo(1.0), gains.servo(-1.0)) == (0.15, 0.85)


def test_speed_rises_at_the_acceleration_limit_and_falls_at_once():
    limiter = DriveLimiter(LIMITS)
    speeds = [limiter.apply(0.8, 0.0, 0.1 * k).speed_mps for k in range(4)]
    assert speeds == pytest.approx([0.35, 0.70, 0.8, 0.8])
    assert limiter.apply(0.1, 0.0, 0.31).speed_mps == 0.1


def test_reversal_starts_from_standstill():
    limiter = DriveLimiter(LIMITS)
    for k in range(4):
        limiter.apply(0.8, 0.0, 0.1 * k)
    assert limiter.apply(-0.8, 0.0, 0.31).speed_mps == pytest.approx(-0.035)


def test_after_a_stop_the_speed_starts_again_but_the_wheels_stay():
    limiter = DriveLimiter(LIMITS)
    for k in range(5):
        limiter.apply(0.8, 0.2, 0.1 * k)
    limiter.stop()
    again = limiter.apply(0.8, 0.2, 60.0)
    assert again.speed_mps == pytest.approx(0.35)
    assert again.steering_rad == pytest.approx(0.2)


@pytest.mark.parametrize("speed", [math.nan, math.inf, -math.inf])
def test_not_finite_is_stop(speed):
    limiter = DriveLimiter(LIMITS)
    assert limiter.apply(speed, 0.0, 0.0) is None
    assert limiter.apply(0.5, speed, 0.0) is None
    assert limiter.setpoint.speed_mps == 0.0


@example([(0.0, 0.0, 0.0), (0.0, 1.0, 0.01171875), (0.0, -1.0, 0.5)])  # ended a last bit beyond the limit
@given(
    st.lists(st.tuples(st.floats(-100, 100), st.floats(-10, 10), st.floats(0, 0.5)), min_size=1, max_size=30)
)
def test_no_sequence_of_commands_breaks_a_limit(commands):
    limiter, now, last = DriveLimiter(LIMITS), 0.0, None
    for speed, steering, wait in commands:
        now += wait
        setpoint = limiter.apply(speed, steering, now)
        assert LIMITS.speed_min_mps <= setpoint.speed_mps <= LIMITS.speed_max_mps
        assert LIMITS.steering_min_rad <= setpoint.steering_rad <= LIMITS.steering_max_rad
        if last is not None:
            step = min(wait, 0.1)
            assert abs(setpoint.steering_rad - last.steering_rad) <= 3.2 * step + 1e-9
            assert abs(setpoint.speed_mps) <= abs(last.speed_mps) + 3.5 * step + 1e-9
        last = setpoint


@pytest.mark.parametrize(
    "wrong", [{"speed_max_mps": 0.0}, {"steering_min_rad": 0.1}, {"acceleration_mps2": 0.0}]
)
def test_impossible_limits(wrong):
    with pytest.raises(ValueError, match="around zero"):
        DriveLimits(**wrong)
