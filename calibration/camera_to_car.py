"""Calibrates the camera's pose on the car from images of a ChArUco board and motion-capture poses.

With ``X = T_car_from_camera``, ``Y = T_base_from_pattern`` and, for view i, ``A_i = T_car_from_base`` by motion capture and
``B_i = T_camera_from_pattern`` in the picture, ``A_i Y = X B_i``. The base is the tracked board (best: where the print sits on it is
then fixed, and may be known), or the world itself when the board just stands there (hand-eye).

If Y is known every view gives X by itself. If not, both follow when the car's rotations relative to the base span more than one
axis; for a car on a floor before an upright board they do not, and shifting X and Y together along that axis changes nothing that is seen. Such
sets are refused. The start is closed form (Park and Martin 1994, by OpenCV). The end is the maximum of the likelihood of all corners, in
which the errors of motion capture are marginalised: they move all corners of a view together, so a view's corners are weighted by
``(s^2 I + J S J^T)^-1`` with the derivatives ``J`` of the corners with respect to the poses and their covariance ``S``.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.data.similarity import rotation_angles
from advnerf_core.geometry import Array, invert_transform, make_transform
from calibration.charuco import Detection, board_pose
from calibration.degeneracy import (
    DegenerateDataError,
    PoorFitError,
    mean_rotation,
    require_count,
    rotation_spread,
)
from calibration.measured import LensCalibration, rows_of
from calibration.mount_problem import MountProblem
from calibration.schema import CalibrationError, CameraCalibration

_CONTRADICTION = "did car and board stand still at the stamps, and is the subject the one the camera is on?"
# Fewer agreeing views are refused.
_MIN_VIEWS = 10
# With an unknown pattern pose, the root mean square turn about the second axis must reach this [rad].
_LEAST_SECOND_AXIS_RAD = 0.08
# Number of robust standard deviations from the mean beyond which a view is excluded.
_OUTLIER_FACTOR = 6.0
# With a larger share left out the set is refused.
_MOST_SHARE_LEFT_OUT = 0.4
# A larger reprojection error through the whole chain is refused [px].
_MOST_RMS_PX = 2.0
# Half a percent of a metre is 5 mm, several times what a careful set leaves.
_MOST_STRETCH = 0.005
# With a larger median angle between the views' mounting poses and their mean the set is refused [rad].
_MOST_MEDIAN_RAD = 0.05
# Or a larger median distance [m].
_MOST_MEDIAN_M = 0.05


@dataclass(frozen=True, eq=False)
class MountView:
    """A view of the board while board and car stood still.

    Attributes:
        T_world_from_car: Pose from motion capture ``[4, 4]``.
        T_world_from_board: Pose from motion capture ``[4, 4]``; None if the board is not tracked.
        found: The pattern in the picture.
    """

    T_world_from_car: Array
    T_world_from_board: Array | None
    found: Detection


@dataclass(frozen=True, eq=False)
class MountFit:
    """A fitted mounting pose.

    Attributes:
        T_car_from_camera: ``[4, 4]``.
        T_base_from_pattern: ``[4, 4]``: the pattern on the tracked board, or in the world.
        used: ``[N]`` bool: views that were fitted.
        view_rms_px: ``[N]`` reprojection error of each view through the whole chain; NaN without a board pose.
        rotation_stddev_rad: Standard deviation of the rotation, its largest axis [rad].
        translation_stddev_m: Standard deviation of the translation, its largest axis [m].
        method: Description of the method.
    """

    T_car_from_camera: Array
    T_base_from_pattern: Array
    used: NDArray[np.bool_]
    view_rms_px: Array
    rotation_stddev_rad: float
    translation_stddev_m: float
    method: str

    @property
    def rms_px(self) -> float:
        """Reprojection error of the views that were fitted [px]."""
        return float(np.sqrt(np.mean(self.view_rms_px[self.used] ** 2)))

    def calibration(self, camera: LensCalibration) -> CameraCalibration:
        """Make the camera calibration.

        Raises:
            PoorFitError: The camera does not look ahead, upright.
        """
        residuals = {
            "rms_px": self.rms_px,
            "views_left_out": float((~self.used).sum()),
            "rotation_stddev_deg": float(np.degrees(self.rotation_stddev_rad)),
            "translation_stddev_m": self.translation_stddev_m,
        }
        made = CameraCalibration(
            date=datetime.date.today(),
            method=self.method,
            views=int(self.used.sum()),
            residuals={key: round(value, 6) for key, value in residuals.items()},
            rms_px=camera.rms_px,
            T_car_from_camera=rows_of(self.T_car_from_camera),
            **{
                key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy", "distortion")
            },
        )
        try:
            made.mount  # noqa: B018  # everything that reads the file asks for it
        except CalibrationError as error:
            raise PoorFitError(
                f"{error}; does the subject's x axis point forward and its z axis up?"
            ) from error
        return made


def calibrate_mount(
    views: Sequence[MountView],
    camera: LensCalibration,
    T_board_from_pattern: ArrayLike | None = None,
) -> MountFit:
    """Find the mounting pose of the camera.

    Args:
        views: Views while everything stood still; all with a tracked board, or none.
        T_board_from_pattern: Pose of the print on the tracked board ``[4, 4]``, probed with a wand; None solves for it.

    Raises:
        DegenerateDataError: Too few views, or rotations about one axis only with an unknown pattern pose.
        PoorFitError: The views contradict each other.
    """
    tracked = all(view.T_world_from_board is not None for view in views)
    if T_board_from_pattern is not None and not tracked:
        raise DegenerateDataError(
            "expected a tracked board with a pattern of known pose, got views without the board's pose"
        )
    matrix, distortion = camera.pinhole.matrix, np.array(camera.distortion)
    seen = [board_pose(view.found, matrix, distortion) for view in views]
    good = np.array([pose is not None for pose in seen], np.bool_)
    cure = "stop at more places, with the board near and slanted"
    require_count(int(good.sum()), _MIN_VIEWS, "views with an unambiguous board", cure)
    chosen = [view for view, keep in zip(views, good, strict=True) if keep]
    T_camera_from_pattern = np.stack([pose for pose in seen if pose is not None])
    T_base_from_car = np.stack([_base_from_car(view, tracked) for view in chosen])
    known = None if T_board_from_pattern is None else np.asarray(T_board_from_pattern, np.float64)
    if known is None:
        _require_axes(T_base_from_car, tracked)
    X, Y, inside = _start(T_base_from_car, T_camera_from_pattern, known)
    problem = MountProblem(T_base_from_car, [view.found for view in chosen], matrix, distortion, known)
    X, Y, turn_stddev, move_stddev = problem.solve(X, Y, inside)
    _require_size(*problem.stretch(X, Y, inside))
    rms = problem.view_rms(X, Y)
    used, all_rms = np.zeros(len(views), np.bool_), np.full(len(views), np.nan)
    used[np.flatnonzero(good)[inside]], all_rms[good] = True, rms
    fit = MountFit(X, Y, used, all_rms, turn_stddev, move_stddev, _method(tracked, known is not None))
    if fit.rms_px > _MOST_RMS_PX:
        raise PoorFitError(
            f"expected the chain from motion capture to the picture to close within {_MOST_RMS_PX} px, got {fit.rms_px:.1f} px; did "
            "car and board stand still, is the lens this camera's, the square size right, the subject's axes those of the car?"
        )
    return fit


def _require_size(stretch: float, stddev: float) -> None:
    if abs(stretch) > max(_MOST_STRETCH, 4.0 * stddev):
        how = "larger" if stretch > 0.0 else "smaller"
        raise PoorFitError(
            f"expected squares of the given size, got some that look {100.0 * abs(stretch):.1f} % {how} to motion capture: measure --square on the "
            "print, which printers scale, and calibrate the lens at this resolution; a focal length that is wrong by as much looks the same"
        )


def _method(tracked: bool, known: bool) -> str:
    if not tracked:
        return "hand-eye on a standing ChArUco board, then reprojection error"
    where = "pattern pose given" if known else "pattern pose solved jointly"
    return f"ChArUco board tracked by motion capture, {where}, then reprojection error"


def _base_from_car(view: MountView, tracked: bool) -> Array:
    if not tracked or view.T_world_from_board is None:
        return view.T_world_from_car
    return invert_transform(view.T_world_from_board) @ view.T_world_from_car


def _require_axes(T_base_from_car: Array, tracked: bool) -> None:
    spread = rotation_spread(T_base_from_car[:, :3, :3])
    if spread[1] < _LEAST_SECOND_AXIS_RAD:
        first, second = np.degrees(spread[:2])
        cure = (
            "tilt the board into several directions, or give the pattern's pose on it"
            if tracked
            else "track the board"
        )
        raise DegenerateDataError(
            f"expected rotations about more than one axis, got planar ones: {first:.1f} degrees about the first and {second:.2f} about the "
            f"second (at least {np.degrees(_LEAST_SECOND_AXIS_RAD):.1f}); height and the pattern's pose stay open: {cure}, or tilt the car by hand"
        )


def _start(
    T_base_from_car: Array, T_camera_from_pattern: Array, known: Array | None
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Closed form, chordal means, and the views that agree with them."""
    inside: NDArray[np.bool_] = np.ones(len(T_base_from_car), np.bool_)
    Y = known if known is not None else _closed_form(T_base_from_car, T_camera_from_pattern)
    for _ in range(10):
        each = invert_transform(T_base_from_car) @ Y @ invert_transform(T_camera_from_pattern)
        X = _mean_pose(each[inside])
        if known is None:
            Y = _mean_pose((T_base_from_car @ X @ T_camera_from_pattern)[inside])
            each = invert_transform(T_base_from_car) @ Y @ invert_transform(T_camera_from_pattern)
        again = _agreeing(*_distances(each, X))
        if (again == inside).all():
            break
        inside = again
    turn, move = (float(np.median(error)) for error in _distances(each, X))
    if turn > _MOST_MEDIAN_RAD or move > _MOST_MEDIAN_M:
        raise PoorFitError(
            f"expected views that agree on one mounting pose, got half of them more than {np.degrees(turn):.1f} degrees and "
            f"{1000.0 * move:.0f} mm from the mean; {_CONTRADICTION}"
        )
    needed = max(_MIN_VIEWS, int(np.ceil((1.0 - _MOST_SHARE_LEFT_OUT) * len(inside))))
    if inside.sum() < needed:
        raise PoorFitError(
            f"expected at least {needed} of {len(inside)} views to agree on one mounting pose, got {int(inside.sum())}; {_CONTRADICTION}"
        )
    return X, Y, inside


def _closed_form(T_base_from_car: Array, T_camera_from_pattern: Array) -> Array:
    # The method goes by keyword: as the fifth positional argument it would be taken for an output and ignored.
    turn, move = cv2.calibrateHandEye(
        list(T_base_from_car[:, :3, :3]),
        list(T_base_from_car[:, :3, 3]),
        list(T_camera_from_pattern[:, :3, :3]),
        list(T_camera_from_pattern[:, :3, 3]),
        method=cv2.CALIB_HAND_EYE_PARK,
    )
    return _mean_pose(T_base_from_car @ make_transform(turn, move.ravel()) @ T_camera_from_pattern)


def _mean_pose(poses: Array) -> Array:
    # The median of the translations starts the rejection without its outliers.
    return make_transform(mean_rotation(poses[:, :3, :3]), np.median(poses[:, :3, 3], axis=0))


def _distances(each: Array, X: Array) -> tuple[Array, Array]:
    turn = rotation_angles(X[:3, :3].T @ each[:, :3, :3])
    return turn, np.asarray(np.linalg.norm(each[:, :3, 3] - X[:3, 3], axis=1))


def _agreeing(turn: Array, move: Array) -> NDArray[np.bool_]:
    inside = np.ones(len(turn), np.bool_)
    for error, floor in ((turn, np.radians(0.3)), (move, 0.004)):
        # Of a norm of three normal errors the median is 1.54 standard deviations.
        inside &= error <= max(_OUTLIER_FACTOR * float(np.median(error)) / 1.54, floor)
    return inside
