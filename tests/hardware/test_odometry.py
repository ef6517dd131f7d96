"""Dead reckoning against circles and against the simulated car."""

import math

import pytest

from hardware.motor.odometry import LONGEST_STEP_S, Odometry
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle

pytestmark = pytest.mark.live


def drive(odometry, speed, steering, duration_s, step_s):
    for step in range(round(duration_s / step_s) + 1):
        odometry.update(speed, steering, round(step * step_s * 1e9))
    return odometry.state


@pytest.mark.parametrize("step_s", [0.01, 0.05, 0.2])
def test_a_circle_closes_whatever_the_rate(step_s):
    wheelbase, steering = 0.25, 0.2
    radius = wheelbase / math.tan(steering)
    quarter = drive(Odometry(wheelbase), radius * math.pi / 2 / 2.0, steering, 2.0, step_s)
    assert (quarter.x_m, quarter.y_m, quarter.yaw_rad) == pytest.approx(
        (radius, radius, math.pi / 2), abs=1e-9
    )
    back = drive(Odometry(wheelbase), -radius * math.pi / 2 / 2.0, steering, 2.0, step_s)
    assert (back.x_m, back.y_m, back.yaw_rad) == pytest.approx((-radius, radius, -math.pi / 2), abs=1e-9)


def test_straight_on():
    state = drive(Odometry(0.25), 0.5, 0.0, 3.0, 0.05)
    assert (state.x_m, state.y_m, state.yaw_rad, state.speed_mps, state.yaw_rate_radps) == pytest.approx(
        (1.5, 0, 0, 0.5, 0)
    )


def test_follows_the_simulated_car():
    car, odometry = TwinVehicle(CarConfig()), Odometry(CarConfig().wheelbase_m)
    car.command(erpm=3000.0, servo=0.4)
    odometry.update(0.0, 0.0, 0)
    for step in range(1, 401):
        state = car.advance(0.01)
        odometry.update(state.speed_mps, state.steering_rad, step * 10**7)
    assert math.hypot(odometry.state.x_m - state.x_m, odometry.state.y_m - state.y_m) < 0.02
    assert odometry.state.yaw_rad == pytest.approx(state.yaw_rad, abs=0.02)


def test_a_pause_is_not_driven_through_and_nonsense_is_ignored():
    odometry = Odometry(0.25)
    odometry.update(1.0, 0.0, 0)
    assert odometry.update(1.0, 0.0, 10**10).x_m == pytest.approx(LONGEST_STEP_S)
    assert odometry.update(math.nan, 0.0, 2 * 10**10).x_m == pytest.approx(LONGEST_STEP_S)
    assert odometry.update(1.0, 0.0, 5).x_m == pytest.approx(LONGEST_STEP_S)
    with pytest.raises(ValueError, match="wheelbase"):
        Odometry(0.0)
