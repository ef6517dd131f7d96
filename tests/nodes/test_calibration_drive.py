"""The calibration drive on the simulated car: it fits its room, its data fix the gains, and it moves only while armed."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from calibration.vehicle import RecordedDrive, fit_gains
from calibration.vehicle_response import fit_response
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle
from nodes import calibration_drive
from nodes.calibration_drive import UNREAD_KEYS, CalibrationDrive, CalibrationDriveConfig, program
from nodes.lab.doctor import files
from nodes.launching.launch_file import load_launch
from nodes.policy import PolicyNodeConfig
from nodes.runtime.messages import image_message, ns_from_stamp, types
from nodes.runtime.node import Now
from tests.support.messages import filled

CAR, PERIOD_S = CarConfig(), 0.1
REPO = Path(__file__).parents[2]
VEHICLE = REPO / "calibration/twin/vehicle.yaml"
PIXEL = np.zeros((1, 1, 3), np.uint8)


def drive(wheelbase_m=CAR.wheelbase_m, **settings):
    return program(CalibrationDriveConfig(vehicle=VEHICLE, **settings), wheelbase_m)


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


@pytest.fixture(scope="module", params=[None, 0.5], ids=["as it is", "slower"])
def driven(request):
    """Poses at 100 Hz with noise and the commands at 10 Hz, until the node is done."""
    node, vehicle, rng = (
        CalibrationDrive(drive(speed_mps=request.param)),
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
        assert t < 120.0
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


def free_m(text):
    """The free space that a text names: behind the start, in front, right, left [m]."""
    number = r"([\d.]+) m "
    pattern = (
        rf"{number}(?:free )?behind.{{,20}}?, {number}in front, {number}to its right and {number}to its left"
    )
    found = re.search(pattern, " ".join(text.split()))
    return np.array(found.groups(), float)


@pytest.mark.parametrize("text", [calibration_drive.__doc__, (REPO / "docs/calibration.md").read_text()])
@pytest.mark.parametrize("wheelbase_m", [0.2, 0.25, 0.325, 0.35])
@pytest.mark.parametrize("gain", [0.9, 0.95, 1.0, 1.05, 1.1])
def test_cars_of_every_size_keep_to_the_space_that_is_named(text, wheelbase_m, gain):
    poses = np.array(list(arcs(drive(wheelbase_m), wheelbase_m, gain)))
    low, high = poses.min(axis=0), poses.max(axis=0)
    assert ([-low[0], high[0], -low[1], high[1]] < free_m(text)).all()


def arcs(parts, wheelbase_m, gain, period_s=0.01):
    """Places of an ideal car whose wheels turn by another gain than was asked."""
    x_m = y_m = yaw_rad = 0.0
    for part in parts:
        for _ in range(round(part.duration_s / period_s)):
            yaw_rad += part.speed_mps * period_s * math.tan(gain * part.steering_rad) / wheelbase_m
            x_m += part.speed_mps * period_s * math.cos(yaw_rad)
            y_m += part.speed_mps * period_s * math.sin(yaw_rad)
            yield x_m, y_m


def test_the_simulated_car_keeps_to_the_space_that_is_named(driven):
    low, high = driven.poses[:, :2].min(axis=0), driven.poses[:, :2].max(axis=0)
    # The car's gains are 2.5 % off and the motor late: not exactly where the ideal car goes.
    assert ([-low[0], high[0], -low[1], high[1]] < free_m(calibration_drive.__doc__)).all()


def test_it_stands_until_armed_and_begins_an_interrupted_part_again():
    node = CalibrationDrive(drive())
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
        CalibrationDriveConfig(vehicle=VEHICLE, slow_mps=0.8, fast_mps=0.9)


def test_the_wheelbase_is_that_of_the_vehicle_file(tmp_path, node_context):
    long = tmp_path / "vehicle.yaml"
    long.write_text(VEHICLE.read_text().replace("wheelbase_m: 0.25", "wheelbase_m: 0.35"))
    node = CalibrationDrive.build(CalibrationDriveConfig(vehicle=long), node_context)
    say(node, True, 0.0)
    half_circle_s = math.pi * 0.35 / math.tan(0.25) / 0.5
    assert command(node, 1.8 + half_circle_s - 0.01) == (0.5, 0.25)
    assert command(node, 1.8 + half_circle_s + 0.01) == (0.5, 0.12)


def test_no_command_is_faster_than_speed_mps():
    assert max(part.speed_mps for part in drive(speed_mps=0.3)) == pytest.approx(0.3)
    assert max(part.speed_mps for part in drive(speed_mps=2.0)) == 0.9
    slow, fast = sorted({round(part.speed_mps, 6) for part in drive(speed_mps=0.45)})
    assert (slow, fast) == (0.25, 0.45)


def test_it_takes_every_key_of_the_policy_node_and_no_misspelt_one():
    mine = CalibrationDriveConfig.model_fields.keys()
    assert PolicyNodeConfig.model_fields.keys() - mine == set(UNREAD_KEYS)
    wanted = {"vehicle": VEHICLE, **dict.fromkeys(UNREAD_KEYS, "x")}
    assert CalibrationDriveConfig.model_validate(wanted).speed_mps is None
    for key in ("fast_mp", "wheelbase_m"):
        with pytest.raises(ValueError, match=key):
            CalibrationDriveConfig.model_validate({**wanted, key: 0.3})
    with pytest.raises(ValueError, match="vehicle"):
        CalibrationDriveConfig.model_validate({"policy": "p.onnx"})


def test_a_launch_of_it_needs_no_policy_file(tmp_path):
    changes = ["policy.module=nodes.calibration_drive", "policy.vehicle=${calibration}/vehicle.yaml"]
    plan = load_launch(REPO / "launch/green_screen.launch.yaml", changes, tmp_path)
    assert files.missing(plan) == []
    plan = load_launch(REPO / "launch/green_screen.launch.yaml", [], tmp_path)
    assert files.missing(plan) == [
        "policy: no file policy.safetensors; correct the path, which is relative to the current folder"
    ]
