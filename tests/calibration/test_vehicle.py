"""Gains, rear axle, delay and lag of the simulated car, whose truth is in its configuration; poor drives refused with the reason."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from advnerf_core.driving.actuated import ActuatedAckermann
from calibration.by_construction import twin_calibrations
from calibration.degeneracy import DegenerateDataError, PoorFitError
from calibration.schema import VehicleCalibration, load_calibration, save_calibration
from calibration.vehicle import RecordedDrive, fit_gains, twist
from calibration.vehicle_response import fit_response, follow, vehicle_calibration
from hardware.worlds.lab.config import LabConfig
from tests.support.drives import CAR, drive, program


@pytest.fixture(scope="module")
def good():
    return drive(np.random.default_rng(0), ahead_m=0.125, turned_rad=0.01)


@pytest.fixture(scope="module")
def gains(good):
    return fit_gains(good, CAR.wheelbase_m)


def test_gains_are_the_true_ones_not_the_nominal_ones(gains):
    assert gains.servo_per_rad == pytest.approx(CAR.true_servo_gain, rel=0.01)
    assert gains.servo_offset == pytest.approx(CAR.true_servo_offset, rel=0.01)
    assert gains.erpm_per_mps == pytest.approx(CAR.true_erpm_gain, rel=0.01)
    assert gains.erpm_offset == pytest.approx(0.0, abs=30.0)
    # Far enough from the nominal ones for this to mean something.
    assert abs(CAR.nominal_servo_gain / gains.servo_per_rad - 1.0) > 0.015
    assert abs(gains.servo_per_rad - CAR.true_servo_gain) < 4.0 * gains.stddev["servo_per_rad"]


def test_the_rear_axle_is_found_behind_the_subjects_origin(gains):
    assert gains.origin_ahead_m == pytest.approx(0.125, abs=0.003)
    assert gains.axis_turned_rad == pytest.approx(0.01, abs=0.003)


def test_delay_lag_and_slew(good, gains):
    fit = fit_response(good, gains)
    # Commands come every 50 ms, and the slew is reached: the parts trade against each other a little, their sum does not.
    assert fit.steering.delay_s == pytest.approx(0.03, abs=0.01)
    assert fit.steering.lag_s == pytest.approx(CAR.steering_lag_s, abs=0.015)
    assert fit.steering.delay_s + fit.steering.lag_s == pytest.approx(0.03 + CAR.steering_lag_s, abs=0.008)
    assert fit.speed.lag_s == pytest.approx(CAR.motor_lag_s, rel=0.1)
    assert fit.speed.delay_s == pytest.approx(0.03, abs=0.01)
    assert fit.pipeline_s == pytest.approx(0.04)
    assert fit.steering.slew is None or fit.steering.slew > 2.0


def test_a_slow_servo_shows_its_slew():
    slow = CAR.model_copy(update={"steering_slew_radps": 1.2, "steering_lag_s": 0.05})
    recorded = drive(np.random.default_rng(1), program(slow, steps=16), slow, delay_s=0.02)
    fit = fit_response(recorded, fit_gains(recorded, slow.wheelbase_m))
    assert fit.steering.slew == pytest.approx(1.2, rel=0.05)
    assert fit.steering.delay_s == pytest.approx(0.02, abs=0.01)


def test_the_model_of_the_fit_is_that_of_the_attack():
    """`follow` against `ActuatedAckermann`, which is what the result is for."""
    commands = [0.2, 0.2, -0.25, -0.25, 0.1, 0.3, -0.1, -0.1]
    dynamics = ActuatedAckermann(0.25, 0.8, 0.1, delay_s=0.13, lag_s=0.06, slew_radps=2.0)
    state, wheels = torch.zeros(1, dynamics.state_size, dtype=torch.float64), [0.0]
    for command in commands:
        state = dynamics.step(state, torch.tensor([command], dtype=torch.float64))
        wheels.append(float(state[0, 3]))
    times = np.concatenate([[-1.0], 0.1 * np.arange(len(commands)) + 0.13])
    ours = follow(times, np.array([0.0, *commands]), 0.1 * np.arange(len(commands) + 1), 0.06, 2.0)
    np.testing.assert_allclose(ours, wheels, atol=1e-9)


def test_twist_of_an_exact_arc():
    t = np.linspace(0.0, 2.0, 50)
    w, v, a = 1.3, 0.7, 0.2
    yaw = 0.4 + w * t
    x = v / w * (np.sin(yaw) - math.sin(0.4)) + a * np.cos(yaw)
    y = -v / w * (np.cos(yaw) - math.cos(0.4)) + a * np.sin(yaw)
    assert twist(t, np.stack([x, y, yaw], axis=1)) == pytest.approx((v, a * w, w), abs=1e-9)
    assert twist(t, np.stack([0.5 * t, 0.2 * t, 0.0 * t], axis=1)) == pytest.approx((0.5, 0.2, 0.0), abs=1e-9)


@pytest.mark.parametrize(
    ("angles", "missing"),
    [
        ((0.0, 0.25, 0.12), "right circle"),
        ((0.0, -0.25, -0.12), "left circle"),
        ((0.2, 0.25, -0.2), "straight run"),
    ],
)
def test_one_sided_drives_are_refused(angles, missing):
    recorded = drive(np.random.default_rng(2), program(angles=angles, steps=0))
    with pytest.raises(DegenerateDataError, match=f"got no {missing}"):
        fit_gains(recorded, CAR.wheelbase_m)


def test_one_speed_is_refused():
    recorded = drive(np.random.default_rng(2), program(speeds=(0.8,), steps=0, hold_s=4.5))
    with pytest.raises(DegenerateDataError, match="at least two speeds"):
        fit_gains(recorded, CAR.wheelbase_m)


def test_a_drive_that_never_holds_a_command_is_refused():
    rows = [(0.3, 0.5 + 0.02 * (k % 9), 3000.0 + 100.0 * (k % 7)) for k in range(40)]
    with pytest.raises(DegenerateDataError, match="at least 6 stretches with constant commands, got"):
        fit_gains(drive(np.random.default_rng(3), rows), CAR.wheelbase_m)


def test_too_little_excitation_is_refused(good, gains):
    calm = type(good)(
        good.pose_s, good.poses, good.command_s, np.full_like(good.servo, 0.53), good.erpm, good.pipeline_s
    )
    with pytest.raises(DegenerateDataError, match=r"sudden changes of steering .* too little excitation"):
        fit_response(calm, gains)


def test_unrelated_commands_are_refused(good):
    shuffled = np.random.default_rng(4).permutation(len(good.servo) // 40 + 1)
    order = np.concatenate([np.arange(40 * k, min(40 * k + 40, len(good.servo))) for k in shuffled])
    with pytest.raises((PoorFitError, DegenerateDataError)):
        fit_gains(
            type(good)(
                good.pose_s, good.poses, good.command_s, good.servo[order], good.erpm, good.pipeline_s
            ),
            0.25,
        )


def test_a_stop_on_the_way_does_no_harm(gains):
    rows = program()
    rows.insert(12, (1.5, rows[11][1], math.nan))
    recorded = drive(np.random.default_rng(6), rows)
    fit = fit_response(recorded, fit_gains(recorded, CAR.wheelbase_m))
    assert fit.speed.lag_s == pytest.approx(CAR.motor_lag_s, rel=0.1)


@pytest.mark.parametrize("turned_deg", [-8.0, 6.0])
def test_a_subject_turned_about_its_z_axis_changes_no_gain(turned_deg):
    turned = drive(np.random.default_rng(0), ahead_m=0.2, turned_rad=math.radians(turned_deg))
    gains = fit_gains(turned, CAR.wheelbase_m)
    assert gains.axis_turned_rad == pytest.approx(math.radians(turned_deg), abs=0.003)
    assert gains.origin_ahead_m == pytest.approx(0.2, abs=0.003)
    assert gains.servo_per_rad == pytest.approx(CAR.true_servo_gain, rel=0.01)
    assert gains.erpm_per_mps == pytest.approx(CAR.true_erpm_gain, rel=0.005)
    fit = fit_response(turned, gains)
    assert fit.steering.delay_s + fit.steering.lag_s == pytest.approx(0.03 + CAR.steering_lag_s, abs=0.008)


@pytest.mark.parametrize("left_m", [0.05, -0.1])
def test_a_subject_beside_the_middle_changes_no_gain_and_is_found(left_m):
    """In turns to one side it is slower than the axle's middle, to the other faster."""
    beside = drive(np.random.default_rng(0), ahead_m=0.125, left_m=left_m)
    gains = fit_gains(beside, CAR.wheelbase_m)
    assert gains.origin_left_m == pytest.approx(left_m, abs=0.005)
    assert gains.origin_ahead_m == pytest.approx(0.125, abs=0.003)
    assert gains.servo_offset == pytest.approx(CAR.true_servo_offset, abs=0.002)
    assert gains.servo_per_rad == pytest.approx(CAR.true_servo_gain, rel=0.01)
    assert gains.erpm_per_mps == pytest.approx(CAR.true_erpm_gain, rel=0.005)
    fit = fit_response(beside, gains)
    assert fit.steering.delay_s + fit.steering.lag_s == pytest.approx(0.03 + CAR.steering_lag_s, abs=0.008)


def test_a_servo_at_its_end_is_named():
    end = CAR.servo_from_steering(0.17)  # 0.25 is commanded
    recorded = drive(np.random.default_rng(0), servo_ends=(end, 1.0))
    with pytest.raises(
        PoorFitError, match=r"where the other values' line says 0\.2\d\d: is the servo at its end"
    ):
        fit_gains(recorded, CAR.wheelbase_m)


@pytest.mark.parametrize("slip", [0.0, 0.05])
def test_wheels_that_slip_in_circles_are_told(slip):
    """Exact arcs, in circles slower by the share than the command says."""
    wheelbase_m, hold_s, rate_hz = 0.25, 3.0, 100
    pose, poses, commands = np.zeros(3), [], []
    for speed in (0.5, 0.8):
        for angle in (0.0, 0.25, -0.25, 0.12, -0.12):
            true = speed * (1.0 - slip * (angle != 0.0))
            for _ in range(round(hold_s * rate_hz)):
                commands.append((0.5 - 1.2 * angle, 4600.0 * speed))
                poses.append(pose.copy())
                turn = true * math.tan(angle) / wheelbase_m / rate_hz
                middle = pose[2] + 0.5 * turn
                pose += [true / rate_hz * math.cos(middle), true / rate_hz * math.sin(middle), turn]
    times = np.arange(len(poses)) / rate_hz
    servo, erpm = np.array(commands).T
    drive_ = RecordedDrive(times, np.array(poses), times, servo, erpm, np.full(len(times), 0.04))
    assert fit_gains(drive_, wheelbase_m).slower_in_circles == pytest.approx(slip, abs=0.002)


@pytest.mark.parametrize(
    ("turned_deg", "side"), [(20.0, "20 degrees to the left"), (-45.0, "45 degrees to the right")]
)
def test_a_subject_turned_far_is_refused(turned_deg, side):
    turned = drive(np.random.default_rng(0), turned_rad=math.radians(turned_deg))
    with pytest.raises(PoorFitError, match=f"{side} of the way that the car drives; turn the subject"):
        fit_gains(turned, CAR.wheelbase_m)


def mirrored(recorded):
    return replace(recorded, poses=recorded.poses * [1.0, -1.0, -1.0])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (
            lambda each: replace(each, poses=each.poses + np.array([0.0, 0.0, math.pi])),
            "erpm_per_mps .* backwards",
        ),
        (mirrored, "servo_per_rad .* y left and z up"),
    ],
)
def test_a_gain_of_the_other_sign_is_refused(good, change, named):
    """A car that is told to drive forward with such a file drives backwards, or into the inside of a corner."""
    other = change(good)
    gains = fit_gains(other, CAR.wheelbase_m)
    response = fit_response(other, gains)
    with pytest.raises(PoorFitError, match=rf"expected {named}\? If the car does drive the other way"):
        vehicle_calibration(gains, response, twin_calibrations(LabConfig())["vehicle"])


@pytest.mark.parametrize(
    ("shift_s", "said"),
    [
        (-0.06, "before them"),
        (-0.1, "before them"),
        (-0.3, "before them"),
        (0.7, "600 ms or more after them"),
    ],
)
def test_commands_and_poses_of_two_clocks_are_refused(good, gains, shift_s, said):
    with pytest.raises(PoorFitError, match=f"{said}; are commands and poses on one clock|on one clock"):
        fit_response(replace(good, pose_s=good.pose_s + shift_s), gains)


def test_the_file_round_trip_and_what_the_attack_takes_from_it(good, gains, tmp_path):
    calibration = vehicle_calibration(
        gains, fit_response(good, gains), twin_calibrations(LabConfig())["vehicle"]
    )
    save_calibration(calibration, tmp_path / "vehicle.yaml")
    loaded = load_calibration(VehicleCalibration, tmp_path / "vehicle.yaml")
    assert loaded == calibration
    dynamics = ActuatedAckermann(loaded.wheelbase_m, 0.8, 0.1, **loaded.response.attack_dynamics(3.2))
    assert dynamics.delay_s == pytest.approx(0.07, abs=0.012)
    assert loaded.vehicle_gains.servo(0.0) == pytest.approx(CAR.true_servo_offset, rel=0.01)
