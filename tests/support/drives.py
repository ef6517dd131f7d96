"""Drives of the simulated car with known gains, delay and lag, as motion capture with its noise sees them."""

import numpy as np

from calibration.vehicle import RecordedDrive
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle

POSE_PERIOD_S, COMMAND_PERIOD_S = 0.01, 0.05
CAR = CarConfig()


def program(car=CAR, speeds=(0.6, 1.0), angles=(0.0, 0.25, -0.22, 0.12, -0.12), hold_s=2.5, steps=10):
    """(seconds, servo, erpm): constant commands, then quick steps of steering and speed."""
    rows = []
    for speed in speeds:
        rows += [(hold_s, car.servo_from_steering(a), car.erpm_from_speed(speed)) for a in angles]
    rng = np.random.default_rng(5)
    for index in range(steps):
        angle = (0.26 if index % 2 else -0.24) * rng.uniform(0.4, 1.0)
        speed = speeds[(index // 2) % len(speeds)]
        rows.append((rng.uniform(0.35, 0.7), car.servo_from_steering(angle), car.erpm_from_speed(speed)))
    return rows


def drive(
    rng,
    rows=None,
    car=CAR,
    delay_s=0.03,
    mocap=(0.0005, 0.001),
    ahead_m=0.0,
    turned_rad=0.0,
    pipeline_s=0.04,
    left_m=0.0,
    servo_ends=(0.0, 1.0),
):
    """The commands reach the actuators ``delay_s`` after they were written; the subject's origin is ``ahead_m`` before the axle, ``left_m`` beside it.

    The servo turns no farther than its ends.
    """
    rows = program(car) if rows is None else rows
    ends = np.cumsum([row[0] for row in rows])
    command_s = np.arange(0.0, ends[-1], COMMAND_PERIOD_S)
    which = np.searchsorted(ends, command_s, side="right")
    servo, erpm = (np.array([rows[k][column] for k in which], float) for column in (1, 2))
    vehicle, poses = TwinVehicle(car), []
    events = sorted(
        [(t + delay_s, 0, k) for k, t in enumerate(command_s)]
        + [(t, 1, 0) for t in np.arange(0.0, ends[-1], POSE_PERIOD_S)]
    )
    now = 0.0
    for when, kind, k in events:
        vehicle.advance(max(when - now, 0.0))
        now = when
        if kind == 1:
            state = vehicle.state
            poses.append([when, state.x_m, state.y_m, state.yaw_rad])
        elif np.isfinite(erpm[k]):
            vehicle.command(servo=float(np.clip(servo[k], *servo_ends)), erpm=float(erpm[k]))
        else:
            vehicle.command(servo=float(servo[k]), brake_current_a=20.0)
    seen = np.array(poses)
    yaw = np.unwrap(seen[:, 3])
    x = seen[:, 1] + ahead_m * np.cos(yaw) - left_m * np.sin(yaw)
    y = seen[:, 2] + ahead_m * np.sin(yaw) + left_m * np.cos(yaw)
    noisy = np.stack([x, y, yaw + turned_rad], axis=1) + rng.normal(
        0.0, [mocap[0], mocap[0], mocap[1]], (len(yaw), 3)
    )
    return RecordedDrive(seen[:, 0], noisy, command_s, servo, erpm, np.full(len(servo), pipeline_s))
