"""The simulated car against closed forms: first-order responses, circles, friction, rectangles."""

import itertools
import math

import pytest

from hardware.worlds.footprints import Footprint
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle

CAR = CarConfig()


def driven(seconds=3.0, servo=None, speed_mps=0.8, **extra):
    vehicle = TwinVehicle(CAR, **extra)
    servo = CAR.true_servo_offset if servo is None else servo
    vehicle.command(servo=servo, erpm=speed_mps * CAR.true_erpm_gain)
    vehicle.advance(seconds)
    return vehicle


def test_speed_approaches_its_target_as_a_first_order_system():
    vehicle = TwinVehicle(CAR.model_copy(update={"grip_mps2": 1e3}))
    vehicle.command(erpm=0.8 * CAR.true_erpm_gain)
    for elapsed in (0.1, 0.2, 0.3):
        speed = vehicle.advance(0.1).speed_mps
        assert speed == pytest.approx(0.8 * (1.0 - math.exp(-elapsed / CAR.motor_lag_s)), rel=1e-9)


def test_nominal_erpm_gives_a_speed_error_of_two_percent():
    vehicle = TwinVehicle(CAR)
    vehicle.command(erpm=CAR.erpm_from_speed(0.8))
    assert vehicle.advance(3.0).speed_mps == pytest.approx(0.8 / 1.02, rel=1e-4)


def test_constant_servo_drives_a_circle_of_the_true_radius():
    steering = 0.25
    vehicle = driven(seconds=4.0, servo=CAR.true_servo_offset + CAR.true_servo_gain * steering)
    start = vehicle.state
    radius = CAR.wheelbase_m / math.tan(steering)
    assert start.steering_rad == pytest.approx(steering, abs=1e-9)
    centre = (start.x_m - radius * math.sin(start.yaw_rad), start.y_m + radius * math.cos(start.yaw_rad))
    for _ in range(20):
        state = vehicle.advance(0.1)
        assert math.hypot(state.x_m - centre[0], state.y_m - centre[1]) == pytest.approx(radius, abs=1e-6)


def test_steering_is_slew_limited_then_lags():
    vehicle = TwinVehicle(CAR)
    vehicle.advance(1.0)
    rest = vehicle.state.steering_rad
    vehicle.command(servo=0.15)
    target = (0.15 - CAR.true_servo_offset) / CAR.true_servo_gain
    assert vehicle.advance(0.02).steering_rad - rest == pytest.approx(
        CAR.steering_slew_radps * 0.02, rel=1e-6
    )
    vehicle.advance(0.2)
    remaining = target - vehicle.state.steering_rad
    assert target - vehicle.advance(CAR.steering_lag_s).steering_rad == pytest.approx(
        remaining / math.e, rel=1e-6
    )


def test_left_is_a_smaller_servo_position():
    assert driven(seconds=1.0, servo=0.4).state.yaw_rad > 0.0
    assert driven(seconds=1.0, servo=0.7).state.yaw_rad < 0.0


@pytest.mark.parametrize("current_a", [0.0, 10.0])
def test_coasting_and_braking_stop_in_the_closed_form_distance(current_a):
    vehicle = driven()
    speed, x = vehicle.state.speed_mps, vehicle.state.x_m
    vehicle.command(**({"brake_current_a": current_a} if current_a else {"current_a": 0.0}))
    vehicle.advance(3.0)
    deceleration = CAR.friction_mps2 + CAR.acceleration_per_amp_mps2 * current_a
    assert vehicle.state.speed_mps == 0.0
    assert vehicle.state.x_m - x == pytest.approx(speed**2 / (2.0 * deceleration), rel=1e-2)


def test_duty_zero_stops_harder_than_coasting_and_not_backwards():
    dragged, coasting = driven(), driven()
    dragged.command(duty=0.0)
    coasting.command(current_a=0.0)
    assert 0.0 < dragged.advance(0.2).speed_mps < coasting.advance(0.2).speed_mps
    assert dragged.advance(2.0).speed_mps == 0.0


def test_current_accelerates_and_reverses():
    vehicle = TwinVehicle(CAR)
    vehicle.command(current_a=-10.0)
    assert vehicle.advance(0.5).speed_mps == pytest.approx(-0.5 * (1.6 - CAR.friction_mps2), rel=1e-2)
    vehicle.command(brake_current_a=20.0)
    assert vehicle.advance(1.0).speed_mps == 0.0


def test_it_stops_with_its_nose_at_the_wall_and_can_reverse():
    vehicle = driven(seconds=8.0, room_half_m=4.0)
    nose = vehicle.state.x_m + 0.5 * (CAR.wheelbase_m + CAR.body_length_m)
    assert 4.0 - 0.8 * 0.004 - 1e-9 <= nose <= 4.0
    assert vehicle.blocked
    assert vehicle.state.speed_mps == 0.0
    vehicle.command(erpm=-0.5 * CAR.true_erpm_gain)
    assert vehicle.advance(1.0).x_m < 3.5


def test_it_stops_at_an_obstacle():
    vehicle = driven(seconds=8.0, obstacles=[Footprint(2.0, 0.3, 0.1, 0.2, 0.0)])
    assert vehicle.state.x_m + 0.5 * (CAR.wheelbase_m + CAR.body_length_m) == pytest.approx(1.9, abs=0.005)


def test_it_names_what_it_stands_against():
    shelf, crate = Footprint(2.0, 0.3, 0.1, 0.2, 0.0, "shelf"), Footprint(2.2, 0.0, 0.1, 0.1, 0.0, "crate")
    vehicle = driven(seconds=8.0, obstacles=[crate, shelf], room_half_m=4.0)
    state = vehicle.state
    # The crate is also within reach, 20 cm ahead; the shelf is what stops the car.
    assert vehicle.touches(state.x_m, state.y_m, state.yaw_rad) == "shelf"
    assert vehicle.touches(state.x_m - 0.5, state.y_m, state.yaw_rad) == ""
    assert vehicle.touches(3.99 - 0.5 * (CAR.wheelbase_m + CAR.body_length_m), 2.0, 0.0) == "wall"


def test_overlap_agrees_with_dense_sampling():
    base = Footprint(0.3, -0.2, 0.5, 0.2, 0.4)
    for x, y, yaw in itertools.product((-0.5, 0.1, 0.7, 1.1), (-0.7, -0.1, 0.4), (0.0, 0.7, 2.0)):
        other = Footprint(x, y, 0.3, 0.1, yaw)
        assert base.overlaps(other) == other.overlaps(base) == _sampled_overlap(base, other)


def _sampled_overlap(one, two):
    c, s = math.cos(two.yaw_rad), math.sin(two.yaw_rad)
    steps = [-1.0 + i / 30.0 for i in range(61)]
    for u, v in itertools.product(steps, steps):
        px = two.x_m + c * u * two.half_length_m - s * v * two.half_width_m - one.x_m
        py = two.y_m + s * u * two.half_length_m + c * v * two.half_width_m - one.y_m
        along = px * math.cos(one.yaw_rad) + py * math.sin(one.yaw_rad)
        across = py * math.cos(one.yaw_rad) - px * math.sin(one.yaw_rad)
        if abs(along) < one.half_length_m and abs(across) < one.half_width_m:
            return True
    return False


def test_same_commands_give_identical_states():
    assert driven(servo=0.45).state == driven(servo=0.45).state


def test_substeps_hardly_matter():
    coarse, fine = driven(seconds=2.0, servo=0.4), driven(seconds=0.0, servo=0.4)
    for _ in range(2000):
        fine.advance(0.001)
    assert math.hypot(coarse.state.x_m - fine.state.x_m, coarse.state.y_m - fine.state.y_m) < 1e-3


def test_bad_commands_are_refused():
    vehicle = TwinVehicle(CAR, room_half_m=4.0)
    with pytest.raises(ValueError, match="finite"):
        vehicle.command(erpm=math.nan)
    with pytest.raises(ValueError, match="at most one motor mode"):
        vehicle.command(erpm=1000.0, duty=0.0)
    with pytest.raises(ValueError, match="duty 0"):
        vehicle.command(duty=0.1)
    with pytest.raises(ValueError, match="finite duration"):
        vehicle.advance(-0.1)
    with pytest.raises(ValueError, match="free place"):
        vehicle.reset(3.9, 0.0, 0.0)
