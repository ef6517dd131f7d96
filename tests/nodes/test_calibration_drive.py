"""The calibration drive on the simulated car: it fits its room, its data fix the gains, and it moves only while armed."""

import numpy as np
import pytest

from calibration.vehicle import RecordedDrive, fit_gains
from calibration.vehicle_response import fit_response
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle
from nodes.calibration_drive import CalibrationDrive, CalibrationDriveConfig, program
from nodes.runtime.messages import image_message, ns_from_stamp, types
from nodes.runtime.node import Now
from tests.support.messages import filled

CAR, PERIOD_S = CarConfig(), 0.1
PIXEL = np.zeros((1, 1, 3), np.uint8)


def state(armed, stopping=False):
    return filled(types.SafetyState, armed=armed, stopping=stopping, source="operator")


def say(node, armed, t, stopping=False):
    now = Now(round(1e9 * t), round(1e9 * t))
    assert node.handle("/safety/state", state(armed, stopping), None, now) == []


def command(node, t):
    now = Now(round(1e9 * t), round(1e9 * t))
    (out,) = node.handle("/compositor/image", image_message(PIXEL, round(1e9 * t), "camera"), None, now)
    assert out.topic == "/policy/drive"
    assert ns_from_stamp(out.message.header.stamp) == round(1e9 * t)
    return out.message.drive.speed, out.message.drive.steering_angle


@pytest.fixture(scope="module")
def driven():
    """Poses at 100 Hz with noise and the commands at 10 Hz, until the node is done."""
    node, vehicle, rng = (
        CalibrationDrive(program(CalibrationDriveConfig())),
        TwinVehicle(CAR),
        np.random.default_rng(0),
    )
    say(node, True, 0.0)
    poses, commands, t = [], [], 0.0
    while "done" not in node.status()[1]:
        speed, steering = command(node, t)
        servo, erpm = CAR.servo_from_steering(steering), CAR.erpm_from_speed(speed)
        vehicle.command(servo=servo, erpm=erpm)
        commands.append((t, servo, erpm))
        for k in range(10):
            poses.append((t + 0.01 * k, vehicle.state.x_m, vehicle.state.y_m, vehicle.state.yaw_rad))
            vehicle.advance(0.01)
        t += PERIOD_S
        assert t < 60.0
    seen, sent = np.array(poses), np.array(commands[:-1])
    seen[:, 3] = np.unwrap(seen[:, 3])
    noisy = seen[:, 1:] + rng.normal(0.0, [0.0005, 0.0005, 0.001], (len(seen), 3))
    return RecordedDrive(seen[:, 0], noisy, sent[:, 0], sent[:, 1], sent[:, 2], np.full(len(sent), np.nan))


def test_its_data_fix_gains_delay_and_lag(driven):
    gains = fit_gains(driven, CAR.wheelbase_m)
    assert gains.servo_per_rad == pytest.approx(CAR.true_servo_gain, rel=0.01)
    assert gains.servo_offset == pytest.approx(CAR.true_servo_offset, rel=0.01)
    assert gains.erpm_per_mps == pytest.approx(CAR.true_erpm_gain, rel=0.01)
    response = fit_response(driven, gains)
    assert response.steering.lag_s == pytest.approx(CAR.steering_lag_s, abs=0.015)
    assert response.steering.delay_s == pytest.approx(0.0, abs=0.012)


def test_it_keeps_to_the_room_it_says_it_needs(driven):
    low, high = driven.poses[:, :2].min(axis=0), driven.poses[:, :2].max(axis=0)
    # The car's gains are 2.5 % off and the motor late: not exactly where the ideal car goes.
    assert (high - low <= [6.2, 5.6]).all()
    assert low[0] > -4.2
    assert low[1] > -3.4


def test_it_stands_until_armed_and_begins_an_interrupted_part_again():
    node = CalibrationDrive(program(CalibrationDriveConfig()))
    assert command(node, 0.0) == (0.0, 0.0)
    assert "waiting for arming" in node.status()[1]
    say(node, True, 5.0)
    assert command(node, 5.0) == (0.5, 0.0)
    assert command(node, 6.7) == (0.5, 0.0)
    say(node, True, 6.75, stopping=True)
    assert command(node, 6.76) == (0.0, 0.0)
    say(node, True, 20.0)
    # 1.75 s of the first part were driven; all of it comes again.
    assert command(node, 21.7) == (0.5, 0.0)
    speed, steering = command(node, 21.9)
    assert (speed, steering) == pytest.approx((0.5, 0.25))
    say(node, False, 22.0)
    assert command(node, 22.1) == (0.0, 0.0)


def test_speeds_and_angles_must_differ():
    with pytest.raises(ValueError, match=r"at least 1\.3 times"):
        CalibrationDriveConfig(slow_mps=0.8, fast_mps=0.9)
