"""The Dubins car against exact arcs, the closed form of its lag, and an independent integration."""

import math

import pytest
from scipy.integrate import solve_ivp

from hardware.worlds.junction.car import DubinsCar
from hardware.worlds.junction.config import DubinsConfig


def anywhere(x_m, y_m, yaw_rad):
    return True


def test_without_lag_it_drives_exact_arcs():
    car = DubinsCar(DubinsConfig.ideal(), anywhere)
    car.reset(1.0, -2.0, 0.3)
    x, y, yaw = 1.0, -2.0, 0.3
    for rate in (0.8, -0.5, 0.0, 1.2):
        state = car.advance(rate, 6.0, 0.1)
        if rate == 0.0:
            x, y = x + 0.6 * math.cos(yaw), y + 0.6 * math.sin(yaw)
        else:
            radius = 6.0 / rate
            x += radius * (math.sin(yaw + 0.1 * rate) - math.sin(yaw))
            y -= radius * (math.cos(yaw + 0.1 * rate) - math.cos(yaw))
        yaw += 0.1 * rate
        assert (state.x_m, state.y_m, state.yaw_rad) == pytest.approx((x, y, yaw), abs=1e-12)
        assert (state.speed_mps, state.steering_rad) == (6.0, 0.0)


def test_the_turn_rate_lags_and_is_off_by_its_gain():
    config = DubinsConfig()
    car = DubinsCar(config, anywhere)
    car.reset(0.0, 0.0, 0.0)
    u, t = 1.02 * 0.7, 0.25
    state = car.advance(0.7, 6.0, t)
    assert car.turn_rate_radps == pytest.approx(u * (1.0 - math.exp(-t / 0.12)), rel=1e-12)
    assert state.yaw_rad == pytest.approx(u * (t - 0.12 * (1.0 - math.exp(-t / 0.12))), rel=1e-12)


def test_it_moves_as_the_differential_equation_says():
    config = DubinsConfig()
    car = DubinsCar(config, anywhere)
    car.reset(0.0, 0.0, 0.0)
    now = [0.0, 0.0, 0.0, 0.0]
    for u in (1.0, -0.6, 0.2):
        state = car.advance(u, 6.0, 0.1)

        def motion(_, s, target=1.02 * u):
            return [6.0 * math.cos(s[2]), 6.0 * math.sin(s[2]), s[3], (target - s[3]) / 0.12]

        now = solve_ivp(motion, (0.0, 0.1), now, rtol=1e-10, atol=1e-12).y[:, -1]
        assert (state.x_m, state.y_m, state.yaw_rad) == pytest.approx(tuple(now[:3]), abs=2e-5)


def test_commands_are_clipped_to_the_bound():
    car = DubinsCar(DubinsConfig.ideal(), anywhere)
    car.reset(0.0, 0.0, 0.0)
    assert car.advance(5.0, 6.0, 0.1).yaw_rad == pytest.approx(0.12)
    assert car.advance(-5.0, 6.0, 0.1).yaw_rad == pytest.approx(0.0)


def test_reset_forgets_the_turn():
    car = DubinsCar(DubinsConfig(), anywhere)
    car.advance(1.0, 6.0, 0.3)
    car.reset(3.0, 4.0, 7.0)
    state = car.advance(0.0, 6.0, 0.1)
    assert state.yaw_rad == pytest.approx(7.0 - 2.0 * math.pi)
    assert math.hypot(state.x_m - 3.0, state.y_m - 4.0) == pytest.approx(0.6)


def test_it_stops_where_it_does_not_fit_and_can_be_led_away():
    car = DubinsCar(DubinsConfig.ideal(), lambda x, y, yaw: x <= 1.0)
    car.reset(0.0, 0.0, 0.0)
    state = car.advance(0.0, 6.0, 1.0)
    assert car.blocked
    assert 0.96 < state.x_m <= 1.0
    assert state.speed_mps == 0.0
    car.advance(0.0, -6.0, 0.1)
    assert not car.blocked
    car.reset(2.0, 0.0, 0.0)
    assert car.blocked


@pytest.mark.parametrize("command", [(math.nan, 6.0, 0.1), (0.0, math.inf, 0.1), (0.0, 6.0, -0.1)])
def test_bad_commands_are_refused(command):
    car = DubinsCar(DubinsConfig(), anywhere)
    with pytest.raises(ValueError, match="expected a finite command"):
        car.advance(*command)
    with pytest.raises(ValueError, match="expected a finite pose"):
        car.reset(math.nan, 0.0, 0.0)
