"""Calibrates speed gain, servo gain and offset, and rear axle of the car, from a drive with constant commands and motion capture.

While servo and motor command are constant the car moves with a constant twist: a circle or a straight line. Each such segment gives,
by least squares over its poses, the yaw rate ``w`` and the velocity of the tracked point in the body's frame ``(vx, vy)``. Then:

- the rear axle is the point without sideways velocity. A point ``a`` ahead of it and ``b`` to its left, on a body whose marked x axis is
  turned by ``e``, moves along that body's axes with ``vx = v cos(e) + a w sin(e)`` and ``vy = a w cos(e) - v sin(e)`` for ``b = 0``, so that
  ``vy = a w / cos(e) - vx tan(e)``: all segments together give ``a`` and ``e``;
- the curvature ``k = w / v`` gives the wheel angle ``d = atan(L k)``, and a line through the segments' ``(d, servo)`` gives gain and offset.
  The wheelbase ``L`` is measured with a ruler: fitted together with the gain it could be anything;
- a line through the segments' ``(v, erpm)`` gives the speed gain.

Delay and lag come from how the same drive changes between the segments: `calibration.vehicle_response`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from advnerf_core.geometry import Array
from calibration.degeneracy import DegenerateDataError, PoorFitError, require_count
from calibration.linear import line_stddev, linear_fit

# This time after a change of command is left out [s].
_SETTLE_S = 0.8
# Shorter segments are left out [s].
_LEAST_S = 0.5
# Longer ones are cut, so that one long circle does not count as one measurement [s].
_LONGEST_S = 3.0
# Servo values this near count as equal.
_SERVO_TOLERANCE = 0.004
# Speed commands this near count as equal.
_ERPM_TOLERANCE = 20.0
# Slower segments are left out [m/s].
_LEAST_SPEED_MPS = 0.15
# Both left and right circles must be at least this tight [1/m].
_LEAST_CURVATURE_1PM = 0.3
# Circles wider than this count as straight [1/m].
_STRAIGHT_1PM = 0.12
# A larger scatter of the wheel angles about the line is refused [rad].
_MOST_STEERING_RMS_RAD = 0.02
# A subject that is turned farther about its z axis is refused: every heading is wrong by as much [rad].
_MOST_TURNED_RAD = math.radians(10.0)
# A smaller offset of the subject's origin to the side is not told from the scatter of the speeds [m].
_LEAST_LEFT_M = 0.005
# The outermost angle may be this share of it, and this much [rad], smaller than the others' line says: more is a servo at its end.
_END_SHARE, _END_RAD = 0.1, 0.01
# A larger relative scatter of the speeds about the line is refused.
_MOST_SPEED_RMS = 0.05


@dataclass(frozen=True, eq=False)
class RecordedDrive:
    """A recorded drive.

    Attributes:
        pose_s: Stamps of the motion-capture poses, increasing ``[N]`` [s].
        poses: x [m], y [m], yaw [rad] of the car's subject, yaw unwrapped ``[N, 3]``.
        command_s: Times at which commands were written to the motor controller, increasing ``[M]`` [s], on the same clock.
        servo: Servo value of each ``[M]``.
        erpm: Speed command of each ``[M]`` [electrical rpm]; NaN while braking or letting go.
        pipeline_s: Time from the capture of the image behind each command to its writing ``[M]`` [s]; NaN if unknown.
    """

    pose_s: Array
    poses: Array
    command_s: Array
    servo: Array
    erpm: Array
    pipeline_s: Array


@dataclass(frozen=True)
class Segment:
    """A stretch with constant commands.

    Attributes:
        start_s: Time of its first pose [s].
        end_s: Time of its last pose [s].
        servo: Mean servo value.
        erpm: Mean speed command.
        vx_mps: Velocity of the tracked point along the body's x [m/s].
        vy_mps: Velocity of the tracked point along the body's y [m/s].
        yaw_rate_radps: Yaw rate [rad/s].
    """

    start_s: float
    end_s: float
    servo: float
    erpm: float
    vx_mps: float
    vy_mps: float
    yaw_rate_radps: float


@dataclass(frozen=True, eq=False)
class GainsFit:
    """Gains fitted to the segments.

    Attributes:
        segments: The segments.
        wheelbase_m: Given wheelbase [m].
        servo_per_rad: Servo per wheel angle [1/rad].
        servo_offset: Servo that drives straight.
        erpm_per_mps: Electrical rpm per speed.
        erpm_offset: Electrical rpm at standstill; 0 if the speeds cannot separate it from the gain.
        origin_ahead_m: Distance of the subject's origin ahead of the rear axle [m].
        origin_left_m: Distance of it to the left of the rear axle's middle [m]; 0 unless the speeds in circles to both sides show one.
        axis_turned_rad: Angle of the subject's x axis to the left of the direction of travel [rad].
        speed_mps: Speed of the rear axle in each segment ``[S]``.
        steering_rad: Wheel angle in each segment ``[S]``.
        stddev: Standard deviations by name.
    """

    segments: tuple[Segment, ...]
    wheelbase_m: float
    servo_per_rad: float
    servo_offset: float
    erpm_per_mps: float
    erpm_offset: float
    origin_ahead_m: float
    origin_left_m: float
    axis_turned_rad: float
    speed_mps: Array
    steering_rad: Array
    stddev: dict[str, float]

    def steering_of(self, servo: Array) -> Array:
        """Wheel angles of servo values [rad]."""
        return (servo - self.servo_offset) / self.servo_per_rad

    def speed_of(self, erpm: Array) -> Array:
        """Speeds of electrical rpm [m/s]."""
        return (erpm - self.erpm_offset) / self.erpm_per_mps

    @property
    def slower_in_circles(self) -> float:
        """Share by which the car is slower in circles than on straight runs, of the speed that its command says: wheels that slip."""
        curvature = np.abs(np.tan(self.steering_rad)) / self.wheelbase_m
        ratio = self.speed_mps / self.speed_of(np.array([segment.erpm for segment in self.segments]))
        straight = curvature < _STRAIGHT_1PM
        return float(1.0 - ratio[~straight].mean() / ratio[straight].mean())

    @property
    def steering_rms_rad(self) -> float:
        """Scatter of the wheel angles about the line [rad]."""
        servo = np.array([segment.servo for segment in self.segments])
        return float(np.sqrt(np.mean((self.steering_of(servo) - self.steering_rad) ** 2)))

    @property
    def speed_rms_mps(self) -> float:
        """Scatter of the speeds about the line [m/s]."""
        erpm = np.array([segment.erpm for segment in self.segments])
        return float(np.sqrt(np.mean((self.speed_of(erpm) - self.speed_mps) ** 2)))


def fit_gains(drive: RecordedDrive, wheelbase_m: float) -> GainsFit:
    """Fit the car's gains to a drive.

    Args:
        drive: Circles to both sides, straight runs, two speeds or more.
        wheelbase_m: Distance between the axles, by ruler [m].

    Raises:
        DegenerateDataError: Too few segments, one side only, no straight run, one speed only.
        PoorFitError: The segments lie on no line.
    """
    segments = find_segments(drive)
    _require_variety(segments)
    w = np.array([s.yaw_rate_radps for s in segments])
    vx, vy = (np.array([getattr(s, name) for s in segments]) for name in ("vx_mps", "vy_mps"))
    (ahead_slope, tangent), _ = linear_fit(np.stack([w, -vx], axis=1), vy)
    turned = float(np.arctan(tangent))
    _require_forward(turned)
    ahead = float(ahead_slope * np.cos(turned))
    servo, erpm = (np.array([getattr(s, name) for s in segments]) for name in ("servo", "erpm"))
    along = vx * np.cos(turned) - vy * np.sin(turned)
    left = _origin_left_m(along, erpm, w)
    speed = along + left * w  # of the rear axle's middle
    steering = np.arctan(wheelbase_m * w / speed)
    # The servo value is exact, the angle is measured: angle over servo, then inverted.
    (slope, at_zero), (slope_sd, _) = linear_fit(np.stack([servo, np.ones_like(servo)], axis=1), steering)
    if abs(slope) < 1e-3:
        raise PoorFitError(
            "expected the curvature to follow the servo, got none; is the servo output on, the stamp right?"
        )
    gain, offset = 1.0 / slope, -at_zero / slope
    # The line is best known near the middle of the data; the offset's error is the line's at angle zero.
    offset_sd = line_stddev(servo, steering, slope, at_zero, offset) * abs(gain)
    speed_gain, speed_offset, speed_sd = _speed_line(speed, erpm)
    stddev = {"servo_per_rad": slope_sd * gain**2, "servo_offset": offset_sd, "erpm_per_mps": speed_sd}
    fit = GainsFit(
        tuple(segments),
        wheelbase_m,
        gain,
        offset,
        speed_gain,
        speed_offset,
        ahead,
        left,
        turned,
        speed,
        steering,
        stddev,
    )
    _require_no_end_stop(servo, steering)
    _require_lines(fit)
    return fit


def _origin_left_m(along_mps: Array, erpm: Array, yaw_rate_radps: Array) -> float:
    """Distance of the tracked point to the left of the axle's middle [m], which in left turns is slower than the middle, and in right turns faster."""
    rows = np.stack([erpm, np.ones_like(erpm), -yaw_rate_radps], axis=1)
    (_, _, left), (_, _, left_sd) = linear_fit(rows, along_mps)
    return left if abs(left) > max(3.0 * left_sd, _LEAST_LEFT_M) else 0.0


def _require_forward(turned_rad: float) -> None:
    if abs(turned_rad) > _MOST_TURNED_RAD:
        side = "left" if turned_rad > 0.0 else "right"
        raise PoorFitError(
            f"expected a subject whose x axis points forward, got one {np.degrees(abs(turned_rad)):.0f} degrees to the {side} of the way that the car "
            "drives; turn the subject in Tracker, or every heading is wrong"
        )


def find_segments(drive: RecordedDrive) -> list[Segment]:
    """Stretches with constant commands, settled, with their twists."""
    if len(drive.command_s) < 2 or len(drive.pose_s) < 10:
        raise DegenerateDataError(
            f"expected commands and poses of a drive, got {len(drive.command_s)} commands and {len(drive.pose_s)} poses"
        )
    segments = []
    for start, end, servo, erpm in _constant_stretches(drive):
        begin = start + _SETTLE_S
        pieces = max(1, int(np.ceil((end - begin) / _LONGEST_S)))
        edges = np.linspace(begin, end, pieces + 1)
        for a, b in pairwise(edges):
            inside = (drive.pose_s >= a) & (drive.pose_s <= b)
            if b - a < _LEAST_S or inside.sum() < 10:
                continue
            vx, vy, w = twist(drive.pose_s[inside], drive.poses[inside])
            if np.hypot(vx, vy) >= _LEAST_SPEED_MPS:
                segments.append(Segment(float(a), float(b), servo, erpm, vx, vy, w))
    return segments


def twist(time_s: Array, poses: Array) -> tuple[float, float, float]:
    """The constant twist that explains poses ``[N, 3]`` best: body velocities vx, vy [m/s] and yaw rate [rad/s].

    Under a constant twist the position is an affine function of ``(S, C)`` with ``S = sin(w t) / w``, ``C = (1 - cos(w t)) / w`` and the
    yaw at the middle, so for a yaw rate from the yaw alone everything else is linear.
    """
    t = time_s - time_s.mean()
    (w, yaw), _ = linear_fit(np.stack([t, np.ones_like(t)], axis=1), poses[:, 2])
    sine = t * np.sinc(w * t / np.pi)
    cosine = 0.5 * w * t**2 * np.sinc(0.5 * w * t / np.pi) ** 2
    one, zero = np.ones_like(t), np.zeros_like(t)
    # x' = vx cos - vy sin, y' = vx sin + vy cos in the frame of the yaw at the middle.
    c, s = np.cos(yaw), np.sin(yaw)
    along, across = c * poses[:, 0] + s * poses[:, 1], c * poses[:, 1] - s * poses[:, 0]
    rows = np.concatenate(
        [np.stack([sine, -cosine, one, zero], axis=1), np.stack([cosine, sine, zero, one], axis=1)]
    )
    (vx, vy, _, _), _ = linear_fit(rows, np.concatenate([along, across]))
    return vx, vy, w


def _constant_stretches(drive: RecordedDrive) -> list[tuple[float, float, float, float]]:
    """Start, end, mean servo and mean erpm of runs in which each command is near the run's first."""
    stretches, first = [], 0
    servo, erpm, when = drive.servo, drive.erpm, drive.command_s
    for row in range(1, len(when) + 1):
        same = (
            row < len(when)
            and abs(servo[row] - servo[first]) <= _SERVO_TOLERANCE
            and abs(erpm[row] - erpm[first]) <= _ERPM_TOLERANCE
        )  # NaN is like nothing, itself included
        if same:
            continue
        if np.isfinite(erpm[first]) and row - first > 1:
            run = slice(first, row)
            end = when[min(row, len(when) - 1)]
            stretches.append(
                (float(when[first]), float(end), float(servo[run].mean()), float(erpm[run].mean()))
            )
        first = row
    return stretches


def _require_variety(segments: list[Segment]) -> None:
    cure = f"hold each command for {_SETTLE_S + _LEAST_S:.1f} s or more: circles to both sides, straight runs, two speeds"
    require_count(len(segments), 6, "stretches with constant commands", cure)
    curvature = np.array(
        [s.yaw_rate_radps / np.hypot(s.vx_mps, s.vy_mps) * np.sign(s.vx_mps) for s in segments]
    )
    tight = _LEAST_CURVATURE_1PM
    missing = [
        name
        for name, there in (
            ("left circle", (curvature > tight).any()),
            ("right circle", (curvature < -tight).any()),
            ("straight run", (np.abs(curvature) < _STRAIGHT_1PM).any()),
        )
        if not there
    ]
    if missing:
        raise DegenerateDataError(
            f"expected left circles, right circles and straight runs, got no {', no '.join(missing)} among {len(segments)} stretches "
            f"(curvatures {curvature.min():.2f} to {curvature.max():.2f} 1/m): gain and offset would rest on one side"
        )
    erpm = np.array([s.erpm for s in segments])
    if np.ptp(erpm) < 0.2 * np.abs(erpm).max():
        raise DegenerateDataError(
            f"expected at least two speeds that differ by a fifth, got {erpm.min():.0f} to {erpm.max():.0f} erpm only: an offset would hide in the gain"
        )


def _speed_line(speed: Array, erpm: Array) -> tuple[float, float, float]:
    """Gain, offset and the gain's standard deviation; no offset unless the data show one beyond doubt."""
    (slope, at_zero), (slope_sd, zero_sd) = linear_fit(np.stack([erpm, np.ones_like(erpm)], axis=1), speed)
    if abs(at_zero) < 3.0 * zero_sd or abs(at_zero) < 0.005:
        (slope,), (slope_sd,) = linear_fit(erpm[:, None], speed)
        at_zero = 0.0
    if abs(slope) < 1e-6:
        raise PoorFitError(
            "expected the speed to follow the command, got none; is the motor on, the car on the floor?"
        )
    return 1.0 / slope, -at_zero / slope, slope_sd / slope**2


def _require_no_end_stop(servo: Array, steering_rad: Array) -> None:
    """Raise for wheels that the outermost servo value of a side turns less than the line through the other values says."""
    level = np.round(servo / _SERVO_TOLERANCE)
    for end in (level.min(), level.max()):
        outer = level == end
        if len(np.unique(level[~outer])) < 3:
            continue
        (slope, at_zero), _ = linear_fit(
            np.stack([servo[~outer], np.ones((~outer).sum())], axis=1), steering_rad[~outer]
        )
        said, found = slope * float(servo[outer].mean()) + at_zero, float(steering_rad[outer].mean())
        less = (said - found) * np.sign(said)
        if less > max(_END_SHARE * abs(said), _END_RAD):
            raise PoorFitError(
                f"expected wheel angles on a line, got {found:.3f} rad at servo {servo[outer].mean():.3f}, where the other values' line says {said:.3f}: "
                "is the servo at its end, or a wheel at its stop? Record the drive with smaller angles, and narrow servo_min and servo_max"
            )


def _require_lines(fit: GainsFit) -> None:
    if fit.steering_rms_rad > _MOST_STEERING_RMS_RAD:
        raise PoorFitError(
            f"expected wheel angles on a line within {_MOST_STEERING_RMS_RAD:.3f} rad, got {fit.steering_rms_rad:.3f} rad; does the car "
            "slip, is the servo at its end, are commands and poses on one clock?"
        )
    fast = float(np.abs(fit.speed_mps).max())
    if fit.speed_rms_mps > _MOST_SPEED_RMS * fast:
        raise PoorFitError(
            f"expected speeds on a line within {100 * _MOST_SPEED_RMS:.0f} %, got {fit.speed_rms_mps:.3f} m/s at up to {fast:.2f} m/s; was the "
            "floor level, the battery full, the car lifted?"
        )
