"""Calibrates delay, first-order lag and slew of the steering, and delay and lag of the speed.

The commands of the drive go through the model of `advnerf_core.driving.actuated` (the wheel angle ``d`` follows a delayed command ``c`` by
``dd/dt = clip((c - d) / lag, -slew, slew)``), the yaw rate is ``v tan(d) / L`` with the measured speed, and what the model turns in 60 ms
is compared with what motion capture saw. A search over the delay (the peak of the cross-correlation between command and motion)
starts least squares over all parameters.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from advnerf_core.geometry import Array
from calibration.degeneracy import DegenerateDataError, PoorFitError
from calibration.schema import GainsSection, ResponseSection, VehicleCalibration, measured
from calibration.vehicle import GainsFit, RecordedDrive

GRID_S, WINDOW = 0.01, 6  # the window in steps of the grid
_DELAYS_S = np.arange(0.0, 0.41, 0.02)
_SLEW_RANGE = (0.3, 30.0)
_DELAY_RANGE_S = (-0.1, 0.6)
# On one clock, stamps of commands and of poses are good to a few milliseconds.
_EARLY_S = 0.01
# A stop is not first order: the following motion counts again after this time.
_AFTER_STOP_S = 1.0
# Fewer changes of the command are refused.
_MIN_CHANGES = 6
# A change of the wheel angle below this does not count [rad].
_LEAST_STEERING_STEP_RAD = 0.08
# A change of the speed below this does not count [m/s].
_LEAST_SPEED_STEP_MPS = 0.15
# A larger share of the motion's variance left by the model is refused.
_MOST_UNEXPLAINED = 0.1
# A gain or wheelbase that differs by more than this from the file of the drive is remarked; so are limits so much beyond the servo's reach [rad].
_OTHER_SIZE, _REACH_RAD = 1.5, 0.01


@dataclass(frozen=True, eq=False)
class Followed:
    """One channel's fit.

    Attributes:
        delay_s: Time from the written command until the motion begins [s].
        lag_s: Time constant [s].
        slew: Greatest rate [units/s]; None if nothing reached it.
        delay_stddev_s: Standard deviation of the delay [s].
        lag_stddev_s: Standard deviation of the lag [s].
        unexplained: Share of the variance that the model leaves.
        time_s: Middles of the windows ``[K]`` [s].
        seen: Change in each window by motion capture ``[K]``.
        modelled: The same by the model ``[K]``.
    """

    delay_s: float
    lag_s: float
    slew: float | None
    delay_stddev_s: float
    lag_stddev_s: float
    unexplained: float
    time_s: Array
    seen: Array
    modelled: Array


@dataclass(frozen=True, eq=False)
class ResponseFit:
    """Steering (changes of yaw [rad] in a window) and speed (distances [m] in a window)."""

    steering: Followed
    speed: Followed
    pipeline_s: float

    @property
    def section(self) -> ResponseSection:
        """Convert to the entry of the vehicle file."""
        slew = self.steering.slew
        return ResponseSection(
            pipeline_delay_s=round(self.pipeline_s, 5),
            steering_delay_s=round(self.steering.delay_s, 5),
            steering_lag_s=round(self.steering.lag_s, 5),
            steering_slew_radps=None if slew is None else round(slew, 4),
            speed_delay_s=round(self.speed.delay_s, 5),
            speed_lag_s=round(self.speed.lag_s, 5),
        )


def fit_response(drive: RecordedDrive, gains: GainsFit) -> ResponseFit:
    """Fit delay and lag to the drive whose gains are known.

    Raises:
        DegenerateDataError: The commands change too seldom or too little.
        PoorFitError: The model leaves too much of the motion unexplained.
    """
    steering = gains.steering_of(drive.servo)
    stopped = ~np.isfinite(drive.erpm)
    speed = np.where(stopped, 0.0, gains.speed_of(np.where(stopped, 0.0, drive.erpm)))
    _require_changes(steering, _LEAST_STEERING_STEP_RAD, _MIN_CHANGES, "steering", "rad")
    _require_changes(speed, _LEAST_SPEED_STEP_MPS, max(_MIN_CHANGES // 2, 2), "speed", "m/s")
    grid = np.arange(drive.pose_s[0], drive.pose_s[-1], GRID_S)
    yaw, travelled = _motion(drive, gains, grid)
    kept = _in_force(drive, stopped, grid)
    measured_speed = _smooth_speed(travelled)

    def turned(delay: float, lag: float, slew: float) -> Array:
        angle = follow(drive.command_s + delay, steering, grid, lag, slew)
        return _integral(measured_speed * np.tan(angle) / gains.wheelbase_m)

    def moved(delay: float, lag: float, slew: float) -> Array:
        return _integral(follow(drive.command_s + delay, speed, grid, lag, slew))

    return ResponseFit(
        _fit(grid, yaw, turned, kept, True, "steering"),
        _fit(grid, travelled, moved, kept, False, "speed"),
        float(np.nanmedian(drive.pipeline_s)) if np.isfinite(drive.pipeline_s).any() else 0.0,
    )


def follow(command_s: Array, target: Array, at_s: Array, lag_s: float, slew: float = np.inf) -> Array:
    """A first-order lag with a limited rate behind commands that are held until the next.

    Args:
        command_s: Time at which each takes effect, increasing ``[M]`` [s].
        target: The commands ``[M]``; before the first, it stands at the first.
        at_s: Times of the result ``[K]`` [s].
        lag_s: Time constant, > 0 [s].
        slew: Greatest rate [units/s].

    Returns:
        Response ``[K]`` at these times.
    """
    at_command = np.empty(len(target))
    value = float(target[0])
    for k in range(len(target)):
        at_command[k] = value
        if k + 1 < len(target):
            value = float(_after(value, target[k], command_s[k + 1] - command_s[k], lag_s, slew))
    row = np.maximum(np.searchsorted(command_s, at_s, side="right") - 1, 0)
    return np.asarray(
        _after(at_command[row], target[row], np.maximum(at_s - command_s[row], 0.0), lag_s, slew)
    )


def _after(
    value: Array | float, target: Array | float, dt_s: Array | float, lag_s: float, slew: float
) -> Array:
    """Closed form for a constant command: the limit until the error is ``slew * lag``, then an exponential."""
    error = np.subtract(target, value)
    size = np.abs(error)
    limited_s = np.zeros_like(size) if np.isinf(slew) else np.clip(size / slew - lag_s, 0.0, dt_s)
    left = (size - (0.0 if np.isinf(slew) else slew) * limited_s) * np.exp(-(dt_s - limited_s) / lag_s)
    return np.asarray(target - np.sign(error) * left)


def vehicle_calibration(
    gains: GainsFit, response: ResponseFit, before: VehicleCalibration
) -> VehicleCalibration:
    """Make the vehicle calibration, with servo range and limits of the given file.

    Raises:
        PoorFitError: A gain has the other sign than the file that the drive was made with.
    """
    g, steering, speed = before.gains, response.steering, response.speed
    _require_sign(
        "erpm_per_mps", gains.erpm_per_mps, g.erpm_per_mps, "does the subject's x axis point backwards"
    )
    _require_sign(
        "servo_per_rad", gains.servo_per_rad, g.servo_per_rad, "do the poses have x forward, y left and z up"
    )
    residuals = {
        "steering_rms_rad": gains.steering_rms_rad,
        "speed_rms_mps": gains.speed_rms_mps,
        "servo_per_rad_stddev": gains.stddev["servo_per_rad"],
        "servo_offset_stddev": gains.stddev["servo_offset"],
        "erpm_per_mps_stddev": gains.stddev["erpm_per_mps"],
        "origin_ahead_of_axle_m": gains.origin_ahead_m,
        "origin_left_of_axle_m": gains.origin_left_m,
        "axis_turned_rad": gains.axis_turned_rad,
        "steering_delay_stddev_s": steering.delay_stddev_s,
        "steering_lag_stddev_s": steering.lag_stddev_s,
        "steering_unexplained": steering.unexplained,
        "speed_unexplained": speed.unexplained,
    }
    return measured(
        VehicleCalibration,
        date=datetime.date.today(),
        views=len(gains.segments),
        wheelbase_m=gains.wheelbase_m,
        limits=before.limits,
        method="constant-command circles and straight runs by motion capture; delay and lag by least squares on its yaw and way",
        residuals={key: round(float(value), 6) for key, value in residuals.items()},
        response=response.section,
        gains=GainsSection(
            erpm_per_mps=round(gains.erpm_per_mps, 3),
            erpm_offset=round(gains.erpm_offset, 3) + 0.0,
            servo_per_rad=round(gains.servo_per_rad, 6),
            servo_offset=round(gains.servo_offset, 6),
            servo_min=g.servo_min,
            servo_max=g.servo_max,
        ),
    )


def remarks(found: VehicleCalibration, before: VehicleCalibration) -> list[str]:
    """What of a fit is far from the file that the drive was made with, or beyond what the servo reaches."""
    g, lines = found.gains, []
    values = {
        "erpm_per_mps": (g.erpm_per_mps, before.gains.erpm_per_mps),
        "servo_per_rad": (g.servo_per_rad, before.gains.servo_per_rad),
        "wheelbase_m": (found.wheelbase_m, before.wheelbase_m),
    }
    for name, (now, old) in values.items():
        if not 1.0 / _OTHER_SIZE <= now / old <= _OTHER_SIZE:
            lines.append(
                f"warning: {name} is {now:.4g}, {now / old:.2g} times that of --before ({old:.4g}): are poses in metres, and is --wheelbase right?"
            )
    low, high = sorted((end - g.servo_offset) / g.servo_per_rad for end in (g.servo_min, g.servo_max))
    if found.limits.steering_min_rad < low - _REACH_RAD or found.limits.steering_max_rad > high + _REACH_RAD:
        lines.append(
            f"warning: the servo's range reaches {low:+.3f} to {high:+.3f} rad, and the limits that are kept are {found.limits.steering_min_rad:+.3f} to "
            f"{found.limits.steering_max_rad:+.3f} rad: the learned scene would steer farther than the car; narrow them, or centre the servo"
        )
    return lines


def _require_sign(name: str, found: float, before: float, first_guess: str) -> None:
    if found * before < 0.0:
        raise PoorFitError(
            f"expected {name} of the sign that the car drove with, {before:.4g}, got {found:.4g}: {first_guess}? If the car does drive the "
            "other way, correct the sign in the file of --before and record the drive again"
        )


def _require_changes(values: Array, least: float, needed: int, what: str, unit: str) -> None:
    steps = np.abs(np.diff(values))
    found = int((steps >= least).sum())
    if found < needed:
        raise DegenerateDataError(
            f"expected at least {needed} sudden changes of {what} by {least:g} {unit} or more, got {found} (largest "
            f"{steps.max(initial=0.0):.3f} {unit}): too little excitation, delay and lag leave no trace; step the command back and forth"
        )


def _motion(drive: RecordedDrive, gains: GainsFit, grid: Array) -> tuple[Array, Array]:
    """Yaw and distance of the rear axle on the grid ``[K]``."""
    yaw = np.interp(grid, drive.pose_s, drive.poses[:, 2])
    heading = yaw - gains.axis_turned_rad
    cos, sin = np.cos(heading), np.sin(heading)
    x = (
        np.interp(grid, drive.pose_s, drive.poses[:, 0])
        - gains.origin_ahead_m * cos
        + gains.origin_left_m * sin
    )
    y = (
        np.interp(grid, drive.pose_s, drive.poses[:, 1])
        - gains.origin_ahead_m * sin
        - gains.origin_left_m * cos
    )
    middle = 0.5 * (heading[1:] + heading[:-1])
    steps = np.diff(x) * np.cos(middle) + np.diff(y) * np.sin(middle)
    return yaw, np.concatenate([[0.0], np.cumsum(steps)])


def _smooth_speed(travelled: Array) -> Array:
    half = 5
    padded = np.pad(travelled, half, mode="reflect", reflect_type="odd")
    return (padded[2 * half :] - padded[: -2 * half]) / (2 * half * GRID_S)


def _in_force(drive: RecordedDrive, stopped: NDArray[np.bool_], grid: Array) -> NDArray[np.bool_]:
    """Windows after the first command and well after every stop."""
    kept: NDArray[np.bool_] = grid >= drive.command_s[0] + _AFTER_STOP_S
    for row in np.flatnonzero(stopped):
        end = drive.command_s[row + 1] if row + 1 < len(stopped) else np.inf
        kept &= (grid < drive.command_s[row] - WINDOW * GRID_S) | (grid > end + _AFTER_STOP_S)
    return kept[:-WINDOW] & kept[WINDOW:]


def _integral(rate: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * GRID_S)])


def _fit(
    grid: Array,
    seen: Array,
    model: Callable[[float, float, float], Array],
    kept: NDArray[np.bool_],
    with_slew: bool,
    what: str,
) -> Followed:
    change = _windows(seen)[kept]
    if len(change) < 100:
        raise DegenerateDataError(
            f"expected a second or more of driving, got {len(change) * GRID_S:.2f} s without a stop"
        )

    def residuals(p: Array) -> Array:
        slew = float(np.exp(p[2])) if len(p) > 2 else np.inf
        return _windows(model(float(p[0]), float(p[1]), slew))[kept] - change

    first = float(min(_DELAYS_S, key=lambda delay: float(np.sum(residuals(np.array([delay, 0.08])) ** 2))))
    low, high = [_DELAY_RANGE_S[0], 1e-3], [_DELAY_RANGE_S[1], 2.0]
    plain = least_squares(residuals, [first, 0.08], bounds=(low, high), x_scale=[0.02, 0.05])
    found, slew = plain, None
    if with_slew:
        bounds = ([*low, np.log(_SLEW_RANGE[0])], [*high, np.log(_SLEW_RANGE[1])])
        start = np.clip(_slew_start(residuals, plain.x), *bounds)
        limited = least_squares(residuals, start, bounds=bounds, x_scale=[0.02, 0.05, 0.3])
        if limited.cost < 0.98 * plain.cost and np.exp(limited.x[2]) < 0.95 * _SLEW_RANGE[1]:
            found, slew = limited, float(np.exp(limited.x[2]))
    unexplained = float(2.0 * found.cost / np.sum((change - change.mean()) ** 2))
    if unexplained > _MOST_UNEXPLAINED:
        raise PoorFitError(
            f"expected delay and lag to explain all but {100 * _MOST_UNEXPLAINED:.0f} % of the {what}, got {100 * unexplained:.0f} % left; are "
            "commands and poses on one clock, and is /motor/sent what really went out?"
        )
    # Windows overlap WINDOW times, so that many fewer of them are independent.
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * 2.0 * found.cost / len(change) * WINDOW
    delay_sd, lag_sd = np.sqrt(np.diag(covariance))[:2]
    _require_one_clock(float(found.x[0]), float(delay_sd), what)
    middles = grid[WINDOW // 2 : WINDOW // 2 + len(kept)][kept]
    return Followed(
        max(float(found.x[0]), 0.0),
        float(found.x[1]),
        slew,
        float(delay_sd),
        float(lag_sd),
        unexplained,
        middles,
        change,
        change + residuals(found.x),
    )


def _require_one_clock(delay_s: float, stddev_s: float, what: str) -> None:
    """Raise for a motion before its command, and for a delay at the end of the search."""
    low, high = _DELAY_RANGE_S
    early, late = delay_s < -(2.0 * stddev_s + _EARLY_S), delay_s > high - 0.01 * (high - low)
    if early or late:
        got = (
            f"{1000.0 * -delay_s:.0f} ms or more before" if early else f"{1000.0 * high:.0f} ms or more after"
        )
        raise PoorFitError(
            f"expected {what} that follows its commands, got motion {got} them; are commands and poses on one clock? Synchronise the computers, "
            "or correct vicon.latency_s"
        )


def _slew_start(residuals: Callable[[Array], Array], plain: Array) -> Array:
    """Starting point for a limited rate: a limit that is never reached has no slope, and passes for a longer delay and lag."""
    candidates = [
        np.array([delay, lag, np.log(slew)])
        for slew in (0.6, 1.2, 2.4, 4.8)
        for lag in (0.3 * plain[1], 0.8 * plain[1])
        for delay in (plain[0] - 0.04, plain[0])
    ]
    return min(candidates, key=lambda p: float(np.sum(residuals(p) ** 2)))


def _windows(values: Array) -> Array:
    return values[WINDOW:] - values[:-WINDOW]
