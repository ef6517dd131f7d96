"""Calibrates the delay of camera stamps relative to motion capture, by correlating the rotation of camera and car.

Between two frames the camera turns by a rotation that follows from corners tracked from one to the other (as directions, by a
robust Procrustes fit); about the car's vertical axis this is the image's yaw. Motion capture knows the car's yaw at any stamp. The shift
between both that makes them agree best is the offset: the peak of their correlation over a grid of shifts, refined by least squares.
What the camera moves sideways while it turns looks like more turning, in proportion; the free scale takes it.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from advnerf_core.geometry import Array
from advnerf_core.undistortion import ray_slopes
from calibration.degeneracy import DegenerateDataError, PoorFitError, mean_rotation, require_count
from calibration.measured import TimeOffsetCalibration
from calibration.schema import CameraCalibration

_MOST_CORNERS, _LEAST_TRACKED = 300, 25
_INLIER_RAD, _ROUNDS = 0.01, 8
# Poses are smoothed over this long before they are differentiated; it is symmetric and moves nothing.
_SMOOTH_S = 0.05
# Turns near a longer stretch without poses are left out [s].
_GAP_S = 0.1
# The offset is searched between minus and plus this [s].
_LARGEST_S = 0.4
# Step of the search [s].
_STEP_S = 0.005
# Fewer pairs of frames with a known turn are refused.
_MIN_TURNS = 40
# The root mean square turn between frames must reach this [rad].
_LEAST_TURN_RAD = 0.015
# A lower correlation at the peak is refused.
_LEAST_CORRELATION = 0.9
# A second peak of more than this share of the first is ambiguous.
_MOST_SECOND_PEAK = 0.97
# Rhythms up to this period are looked for [s]: nobody turns a car by hand more slowly and alike.
_LONGEST_RHYTHM_S = 2.5
# A larger standard deviation of the result is refused [s].
_MOST_STDDEV_S = 0.003
# A camera ahead of the rear axle by a third of the wall's distance sees half as much turning again. Another lens, or degrees, are farther off.
_LEAST_SCALE, _MOST_SCALE = 0.7, 1.6


@dataclass(frozen=True, eq=False)
class Turns:
    """Turns of the camera between neighbouring frames.

    Attributes:
        start_s: Stamps of the first frames ``[N]`` [s].
        end_s: Stamps of the second frames ``[N]`` [s].
        yaw_rad: Turn about the car's vertical axis, left positive ``[N]`` [rad].
    """

    start_s: Array
    end_s: Array
    yaw_rad: Array


@dataclass(frozen=True, eq=False)
class OffsetFit:
    """The offset and its correlation curve.

    Attributes:
        camera_minus_mocap_s: Camera stamp less mocap stamp of one instant [s].
        stddev_s: Standard deviation of the offset from the residuals [s].
        scale: Image turn per car turn; above 1 if the camera also moves sideways.
        rms_rad: Residual of the turns [rad].
        shifts_s: Shifts of the search ``[K]`` [s].
        correlation: Correlation at each ``[K]``.
        turns: Turns measured in the image.
        car_yaw_rad: Turns from motion capture at the offset ``[N]``, times the scale [rad].
    """

    camera_minus_mocap_s: float
    stddev_s: float
    scale: float
    rms_rad: float
    shifts_s: Array
    correlation: Array
    turns: Turns
    car_yaw_rad: Array

    @property
    def calibration(self) -> TimeOffsetCalibration:
        """Make the calibration."""
        residuals = {
            "rms_rad": self.rms_rad,
            "correlation": float(self.correlation.max()),
            "scale": self.scale,
        }
        return TimeOffsetCalibration(
            date=datetime.date.today(),
            method="image yaw by tracked corners against motion-capture yaw, correlation peak refined by least squares",
            views=len(self.turns.yaw_rad),
            residuals={key: round(value, 6) for key, value in residuals.items()},
            camera_minus_mocap_s=round(self.camera_minus_mocap_s, 6),
            stddev_s=round(self.stddev_s, 6),
        )


def image_turns(frames: Iterable[tuple[float, NDArray[np.uint8]]], camera: CameraCalibration) -> Turns:
    """Track the camera's turning through frames.

    Args:
        frames: Stamp [s] and picture ``[H, W]`` or ``[H, W, 3]`` RGB, in order.
        camera: Lens and mounting pose; only its rotation matters.
    """
    before: tuple[float, NDArray[np.uint8]] | None = None
    rows = []
    for stamp, image in frames:
        grey = np.asarray(
            image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY),
            np.uint8,
        )
        if grey.shape != (camera.height, camera.width):
            raise DegenerateDataError(
                f"expected frames of {camera.width} x {camera.height}, as calibrated, got {grey.shape[1]} x {grey.shape[0]}"
            )
        now = np.ascontiguousarray(grey)
        if before is not None and (turn := _turn(before[1], now, camera)) is not None:
            rows.append((before[0], stamp, turn))
        before = (stamp, now)
    table = np.array(rows, np.float64).reshape(-1, 3)
    return Turns(table[:, 0], table[:, 1], table[:, 2])


def fit_offset(turns: Turns, pose_s: Array, yaw_rad: Array) -> OffsetFit:
    """Find the offset between both clocks.

    Args:
        pose_s: Stamps of the poses, increasing ``[M]`` [s].
        yaw_rad: The car's yaw, unwrapped ``[M]`` [rad].

    Raises:
        DegenerateDataError: Too few frames, too little turning, turning at one rate only, or a rhythm that fits at several shifts.
        PoorFitError: Image and motion capture do not agree at any shift.
    """
    require_count(
        len(pose_s), 100, "poses of the car", "record motion capture with the camera, for ten seconds or more"
    )
    reach = _LARGEST_S + _SMOOTH_S
    inside = (turns.start_s > pose_s[0] + reach) & (turns.end_s < pose_s[-1] - reach)
    for lost, found in _gaps(
        pose_s
    ):  # the car was hidden: no turn near by is known, at no shift of the search
        inside &= (turns.end_s < lost - reach) | (turns.start_s > found + reach)
    turns = Turns(turns.start_s[inside], turns.end_s[inside], turns.yaw_rad[inside])
    require_count(
        len(turns.yaw_rad),
        _MIN_TURNS,
        "pairs of frames with a tracked turn",
        "turn the car before a wall with something on it",
    )
    _require_turning(turns)
    yaw = CubicSpline(pose_s, _smoothed(pose_s, yaw_rad))
    _require_no_rhythm(yaw, turns, float(pose_s[0]))
    count = round(_LARGEST_S / _STEP_S)
    shifts: Array = _STEP_S * np.arange(-count, count + 1, dtype=np.float64)
    correlation = np.array(
        [_correlation(turns.yaw_rad, _car_turns(yaw, turns, float(shift))) for shift in shifts]
    )
    peak = _peak(shifts, correlation)

    def residuals(p: Array) -> Array:
        return p[1] * _car_turns(yaw, turns, float(p[0])) + p[2] - turns.yaw_rad

    found = least_squares(
        residuals, [peak, 1.0, 0.0], loss="soft_l1", f_scale=0.003, x_scale=[0.01, 1.0, 0.01]
    )
    left = residuals(found.x)
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * 2.0 * found.cost / max(len(left) - 3, 1)
    stddev = float(np.sqrt(covariance[0, 0]))
    if stddev > _MOST_STDDEV_S:
        raise DegenerateDataError(
            f"expected an offset known to {1000 * _MOST_STDDEV_S:.0f} ms, got {1000 * found.x[0]:.0f} ms give or take {1000 * stddev:.1f} ms: turn "
            "the car to and fro faster, and longer"
        )
    if not _LEAST_SCALE <= found.x[1] <= _MOST_SCALE:
        raise PoorFitError(
            f"expected pictures that turn about as far as the car ({_LEAST_SCALE:g} to {_MOST_SCALE:g} times), got {found.x[1]:.3g} times: is the lens in "
            "camera.yaml this camera's, does motion capture send radians, and is the wall farther away than the camera from the rear axle?"
        )
    rms = float(np.sqrt(np.mean(left**2)))
    return OffsetFit(
        float(found.x[0]), stddev, float(found.x[1]), rms, shifts, correlation, turns, turns.yaw_rad + left
    )


def _turn(first: NDArray[np.uint8], second: NDArray[np.uint8], camera: CameraCalibration) -> float | None:
    """Turn of the car between two pictures, left positive [rad]; None with too few corners that agree."""
    corners = cv2.goodFeaturesToTrack(first, _MOST_CORNERS, 0.005, 5)
    if corners is None or len(corners) < _LEAST_TRACKED:
        return None
    moved, ok, _ = cv2.calcOpticalFlowPyrLK(
        first, second, corners, np.zeros_like(corners), winSize=(15, 15), maxLevel=4
    )
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(
        second, first, moved, np.zeros_like(corners), winSize=(15, 15), maxLevel=4
    )
    kept = (
        (ok.ravel() > 0)
        & (ok_back.ravel() > 0)
        & (np.linalg.norm((back - corners).reshape(-1, 2), axis=1) < 0.5)
    )
    if kept.sum() < _LEAST_TRACKED:
        return None
    a, b = (_directions(points.reshape(-1, 2)[kept] + 0.5, camera) for points in (corners, moved))
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    if known.sum() < _LEAST_TRACKED:
        return None
    R = _rotation(a[known], b[known])
    if R is None:
        return None
    # R takes directions of the first camera to the second; the camera itself turned the other way.
    about_car = camera.mount[:3, :3] @ Rotation.from_matrix(R.T).as_rotvec()
    return float(about_car[2])


def _directions(pixels: Array, camera: CameraCalibration) -> Array:
    """Unit vectors ``[N, 3]``; NaN where the lens has none."""
    points = ray_slopes(pixels, camera.pinhole.matrix, camera.distortion)
    rays = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _rotation(a: Array, b: Array) -> Array | None:
    """Rotation with ``b = R a`` for most directions: least squares, again and again without those that are farther off than most."""
    inside: NDArray[np.bool_] = np.ones(len(a), np.bool_)
    R = np.eye(3)
    for _ in range(_ROUNDS):
        R = mean_rotation(b[inside, :, None] * a[inside, None, :])
        error = np.linalg.norm(b - a @ R.T, axis=1)
        again = error < max(_INLIER_RAD, 2.0 * float(np.median(error)))
        if again.sum() < _LEAST_TRACKED:
            return None
        if (again == inside).all():
            break
        inside = again
    return R


def _gaps(pose_s: Array) -> Iterator[tuple[float, float]]:
    """Last and next stamp of each stretch without poses [s]."""
    steps = np.diff(pose_s)
    for at in np.flatnonzero(steps > max(_GAP_S, 3.0 * float(np.median(steps)))):
        yield float(pose_s[at]), float(pose_s[at + 1])


def _smoothed(pose_s: Array, yaw_rad: Array) -> Array:
    period = float(np.median(np.diff(pose_s)))
    count = max(3, 2 * round(0.5 * _SMOOTH_S / period) + 1)
    window = np.hanning(count + 2)[1:-1]
    padded = np.pad(yaw_rad, count // 2, mode="reflect", reflect_type="odd")
    return np.convolve(padded, window / window.sum(), mode="valid")


def _car_turns(yaw: CubicSpline, turns: Turns, shift_s: float) -> Array:
    return np.asarray(yaw(turns.end_s - shift_s) - yaw(turns.start_s - shift_s))


def _correlation(a: Array, b: Array) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)


def _require_turning(turns: Turns) -> None:
    rms, spread = float(np.sqrt(np.mean(turns.yaw_rad**2))), float(np.std(turns.yaw_rad))
    if rms < _LEAST_TURN_RAD:
        raise DegenerateDataError(
            f"expected turns of at least {_LEAST_TURN_RAD} rad from frame to frame, got {rms:.4f} rad in the mean: too little "
            "excitation, turn the car to and fro by hand"
        )
    if spread < 0.5 * _LEAST_TURN_RAD:
        raise DegenerateDataError(
            f"expected turns to and fro, got a steady rate ({rms:.4f} rad per frame, varying by {spread:.4f}): it looks the same at any offset"
        )


def _require_no_rhythm(yaw: CubicSpline, turns: Turns, first_s: float) -> None:
    """Refuse turning that repeats itself: an offset beyond the search by one period would be found within it."""
    for period_s in np.arange(_LARGEST_S, _LONGEST_RHYTHM_S, 4.0 * _STEP_S):
        inside = turns.start_s - period_s > first_s
        if inside.sum() < _MIN_TURNS:
            return
        late = Turns(turns.start_s[inside], turns.end_s[inside], turns.yaw_rad[inside])
        alike = _correlation(_car_turns(yaw, late, 0.0), _car_turns(yaw, late, float(period_s)))
        if alike > _MOST_SECOND_PEAK:
            raise DegenerateDataError(
                f"expected irregular turning, got turns that repeat after about {period_s:.2f} s (correlation {alike:.3f}): offsets that differ by as much "
                "look alike; turn the car irregularly, not in a rhythm"
            )


def _peak(shifts: Array, correlation: Array) -> float:
    best = int(np.argmax(correlation))
    if correlation[best] < _LEAST_CORRELATION:
        raise PoorFitError(
            f"expected image and motion capture to turn alike, got a correlation of {correlation[best]:.2f} at best (needed "
            f"{_LEAST_CORRELATION}); is the subject the car the camera is on, is the scene static and lit?"
        )
    if best in (0, len(shifts) - 1):
        raise PoorFitError(
            f"expected an offset within {_LARGEST_S} s, got the best agreement at the end of the search; set the clocks first"
        )
    inner = correlation[1:-1]
    tops = np.flatnonzero((inner >= correlation[:-2]) & (inner > correlation[2:])) + 1
    second = max((float(correlation[top]) for top in tops if abs(top - best) * _STEP_S > 0.05), default=-1.0)
    if second > _MOST_SECOND_PEAK * correlation[best]:
        raise DegenerateDataError(
            f"expected one offset that fits, got two peaks of the correlation ({correlation[best]:.3f} and {second:.3f}): turn the car "
            "irregularly, not in a rhythm"
        )
    return float(shifts[best])
