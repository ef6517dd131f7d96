"""Calibrates focal length, principal point and distortion from images of a ChArUco board (Zhang 2000, with OpenCV)."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array
from calibration.charuco import Detection
from calibration.degeneracy import DegenerateDataError, PoorFitError, require_count
from calibration.measured import LensCalibration

Model = Literal["none", "two-radial", "three-radial"]
_FLAGS = {
    "none": cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
    "two-radial": cv2.CALIB_FIX_K3,
    "three-radial": 0,
}
# OpenCV stops after 30 steps: with few tilted pictures, a focal length far from the best and a standard deviation that does not say so.
_UNTIL_CONVERGED = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 1000, 1e-12)
COVERAGE_CELLS = (8, 6)  # columns, rows
# Seen face on only, a board as twice as far away in twice the focal length looks the same.
_LEAST_TILT_RAD, _LEAST_TILTED = np.radians(12.0), 4
# Corners that all moved less show a board that stands still [px].
_STILL_PX = 0.5
# Fewer pictures with a board are refused.
MIN_VIEWS = 20
# A larger reprojection error is refused [px].
_MOST_RMS_PX = 0.5
# A smaller share of the picture's 8 x 6 cells with a corner in it is refused.
_LEAST_COVERAGE = 0.6
# Pixels of sensors are square to a few parts in a thousand. A ratio farther from 1 is noted if it is beyond its noise.
_SQUARE, _SURE = 0.007, 4.0
# Multiple of the median error beyond which an image is excluded.
_OUTLIER_FACTOR = 3.0


@dataclass(frozen=True, eq=False)
class IntrinsicsFit:
    """A fitted camera.

    Attributes:
        calibration: The file.
        coverage: Corners per cell ``[rows, columns]``.
        used: ``[N]`` bool: pictures that were fitted.
        view_rms_px: ``[N]`` reprojection error of each picture; NaN for excluded ones.
        errors_px: ``[M, 2]`` measured minus predicted positions of all corners.
    """

    calibration: LensCalibration
    coverage: NDArray[np.int64]
    used: NDArray[np.bool_]
    view_rms_px: Array
    errors_px: Array = field(repr=False)


def distinct(views: Sequence[Detection]) -> list[Detection]:
    """The views without copies, and without those in which neither board nor camera has moved since the one before.

    Such views would count as many for one, and make every standard deviation too small.
    """
    kept, known = list[Detection](), set[bytes]()
    for view in views:
        corners = view.board_m.tobytes() + view.pixels.tobytes()
        if corners not in known and not (kept and _still(kept[-1], view)):
            kept.append(view)
        known.add(corners)
    return kept


def _still(one: Detection, other: Detection) -> bool:
    return np.array_equal(one.board_m, other.board_m) and bool(
        np.abs(one.pixels - other.pixels).max() < _STILL_PX
    )


def calibrate_intrinsics(
    views: Sequence[Detection], size: tuple[int, int], model: Model = "two-radial"
) -> IntrinsicsFit:
    """Fit a camera to images of a board.

    Args:
        views: The board's corners in each picture.
        size: Width and height of the pictures [px].
        model: Distortion: none, k1 k2 p1 p2, or these and k3.

    Raises:
        DegenerateDataError: Too few pictures, too little of the picture covered, or the board never tilted.
        PoorFitError: The reprojection error is too large.
    """
    require_count(
        len(views), MIN_VIEWS, "pictures with the board", "take more, from all distances and angles"
    )
    _require_coverage(_coverage(views, size))
    used = np.ones(len(views), np.bool_)
    for _ in range(3):  # a blurred picture spoils the median little; two rounds find them all
        fit = _fit([view for view, keep in zip(views, used, strict=True) if keep], size, model)
        limit = _OUTLIER_FACTOR * float(np.median(fit.view_rms_px))
        keep = fit.view_rms_px <= max(limit, 0.05)
        if keep.all():
            break
        used[np.flatnonzero(used)[~keep]] = False
        require_count(
            int(used.sum()), MIN_VIEWS, "sharp pictures with the board", "hold board and camera still"
        )
    _require_tilt(fit.rotations)
    if fit.rms_px > _MOST_RMS_PX:
        raise PoorFitError(
            f"expected a reprojection error below {_MOST_RMS_PX} px, got {fit.rms_px:.2f} px over {int(used.sum())} pictures; "
            "is the board flat, its size in squares right, the focus fixed, the picture sharp?"
        )
    rms = np.full(len(views), np.nan)
    rms[used] = fit.view_rms_px
    coverage = _coverage([view for view, keep in zip(views, used, strict=True) if keep], size)
    _require_coverage(coverage)
    return IntrinsicsFit(_calibration(fit, size, model, coverage), coverage, used, rms, fit.errors_px)


def pixel_shape_warning(lens: LensCalibration) -> str:
    """A warning if the focal lengths of a fit differ as those of no usual sensor; empty if they do not."""
    ratio, residuals = lens.fx / lens.fy, lens.residuals
    sd = np.hypot(residuals["fx_stddev_px"] / lens.fx, residuals["fy_stddev_px"] / lens.fy)
    if abs(ratio - 1.0) <= max(_SQUARE, _SURE * sd):
        return ""
    return (
        f"warning: expected fx / fy of 1, as of square pixels, but it is {ratio:.3f}: measure squares of the board along both sides, and print it "
        "again if it was stretched along one; a sensor whose pixels are not square, or pictures that were scaled in one direction, do the same"
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    matrix: Array
    distortion: Array
    rms_px: float
    view_rms_px: Array
    stddev: Array
    rotations: Array
    errors_px: Array


def _fit(views: Sequence[Detection], size: tuple[int, int], model: Model) -> _Fit:
    objects = [view.board_m.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    try:
        rms, matrix, distortion, turns, moves, stddev, _, view_rms = cv2.calibrateCameraExtended(
            objects, pixels, size, np.eye(3), np.zeros(5), flags=_FLAGS[model], criteria=_UNTIL_CONVERGED
        )
    except cv2.error as error:
        raise DegenerateDataError(
            f"expected pictures that fix a camera, OpenCV says: {' '.join(str(error).split())}; tilt the board more"
        ) from error
    five = np.zeros(5)
    five[: min(5, distortion.size)] = distortion.ravel()[:5]
    if not (np.isfinite(matrix).all() and np.isfinite(five).all()):
        raise DegenerateDataError(
            "expected pictures that fix a camera, the fit diverged; tilt the board more"
        )
    predicted = [
        cv2.projectPoints(o, r, t, matrix, distortion)[0].reshape(-1, 2)
        for o, r, t in zip(objects, turns, moves, strict=True)
    ]
    errors = np.concatenate([p - q for p, q in zip(pixels, predicted, strict=True)])
    rotations = np.stack([cv2.Rodrigues(turn)[0] for turn in turns])
    f = np.float64
    return _Fit(
        np.asarray(matrix, f),
        five,
        float(rms),
        np.asarray(view_rms, f).ravel(),
        np.asarray(stddev, f).ravel()[:4],
        rotations.astype(f),
        errors.astype(f),
    )


def _coverage(views: Sequence[Detection], size: tuple[int, int]) -> NDArray[np.int64]:
    columns, rows = COVERAGE_CELLS
    pixels = np.concatenate([view.pixels for view in views])
    counts, _, _ = np.histogram2d(
        pixels[:, 1], pixels[:, 0], bins=(rows, columns), range=((0.0, size[1]), (0.0, size[0]))
    )
    return counts.astype(np.int64)


def _require_coverage(coverage: NDArray[np.int64]) -> None:
    share = float((coverage > 0).mean())
    if share < _LEAST_COVERAGE:
        empty = _where_empty(coverage)
        raise DegenerateDataError(
            f"expected corners in at least {100 * _LEAST_COVERAGE:.0f} % of the picture's {coverage.size} cells, got "
            f"{100 * share:.0f} %; hold the board {empty} too: distortion shows there"
        )


def _where_empty(coverage: NDArray[np.int64]) -> str:
    rows, columns = coverage.shape
    sides = {
        "at the left edge": coverage[:, : columns // 4],
        "at the right edge": coverage[:, -(columns // 4) :],
        "at the top": coverage[: rows // 3],
        "at the bottom": coverage[-(rows // 3) :],
    }
    return min(sides, key=lambda name: float((sides[name] > 0).mean()))


def _require_tilt(rotations: Array) -> None:
    tilt = np.arccos(np.clip(np.abs(rotations[:, 2, 2]), 0.0, 1.0))
    tilted = int((tilt > _LEAST_TILT_RAD).sum())
    if tilted < _LEAST_TILTED:
        raise DegenerateDataError(
            f"expected at least {_LEAST_TILTED} pictures with the board tilted by {np.degrees(_LEAST_TILT_RAD):.0f} degrees or more, got "
            f"{tilted}: face on, focal length and distance cannot be told apart"
        )


def _calibration(
    fit: _Fit, size: tuple[int, int], model: Model, coverage: NDArray[np.int64]
) -> LensCalibration:
    residuals = {
        "rms_px": fit.rms_px,
        "worst_view_rms_px": float(fit.view_rms_px.max()),
        "coverage": float((coverage > 0).mean()),
        "fx_stddev_px": float(fit.stddev[0]),
        "fy_stddev_px": float(fit.stddev[1]),
        "cx_stddev_px": float(fit.stddev[2]),
        "cy_stddev_px": float(fit.stddev[3]),
    }
    matrix, d = fit.matrix, [float(v) for v in fit.distortion]
    return LensCalibration(
        date=datetime.date.today(),
        method=f"ChArUco board, {model} distortion",
        views=len(fit.view_rms_px),
        residuals={key: round(value, 6) for key, value in residuals.items()},
        width=size[0],
        height=size[1],
        fx=float(matrix[0, 0]),
        fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]),
        cy=float(matrix[1, 2]),
        distortion=(d[0], d[1], d[2], d[3], d[4]),
        rms_px=round(fit.rms_px, 6),
    )
