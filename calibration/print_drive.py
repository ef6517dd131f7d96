"""True size, pose and flatness of a print from pictures whose camera poses are known in metres, as along a drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from advnerf_core.geometry import Array, Pinhole, invert_transform, make_transform
from calibration.degeneracy import DegenerateDataError, PoorFitError
from calibration.print_markers import LEAST_MARKERS
from calibration.print_model import CORRELATED, LEAST_NOISE_PX, shift_lengths_m
from calibration.print_pose import MOST_ANGLE_RAD, MOST_SHARE, some_pose

_LEAST_VIEWS = 3
_MOST_RMS_PX, _MOST_RMS_SHARE = 1.0, 0.02
_STARTS = 8


@dataclass(frozen=True, eq=False)
class PrintView:
    """One picture of a print.

    Attributes:
        markers: Corners ``[4, 2]`` of its markers by number [px].
        T_world_from_camera: Pose ``[4, 4]`` of the camera.
    """

    markers: Mapping[int, Array]
    T_world_from_camera: Array


@dataclass(frozen=True, eq=False)
class PlacedPrint:
    """A print in the world.

    Attributes:
        scale: True size over nominal size.
        scale_sd: Standard deviation of the scale.
        T_world_from_face: Pose ``[4, 4]`` of the print.
        angle_sd_rad: Standard deviation of the direction that it faces [rad].
        rms_px: Root mean square distance of the corners from their projections [px].
        flatness_m: Root mean square distance of the markers from their plane [m].
        flatness_sd_m: Standard deviation of one such distance [m].
        off_m: Distance of each marker from its place in the print's plane, by number [m].
        views: Number of pictures.
    """

    scale: float
    scale_sd: float
    T_world_from_face: Array
    angle_sd_rad: float
    rms_px: float
    flatness_m: float
    flatness_sd_m: float
    off_m: Mapping[int, float]
    views: int


def place_print(views: Sequence[PrintView], corners_m: Mapping[int, Array], pinhole: Pinhole) -> PlacedPrint:
    """Fit size and pose of a print to all its pictures.

    Args:
        views: Pictures with at least one marker.
        corners_m: Nominal corners ``[4, 3]`` of all markers of the print [m].
        pinhole: Intrinsics of the undistorted pictures.

    Raises:
        DegenerateDataError: Too few pictures, or they do not determine size and pose.
        PoorFitError: Pictures and camera poses contradict each other.
    """
    rich = [each for each in views if len(each.markers) >= LEAST_MARKERS]
    if len(rich) < _LEAST_VIEWS:
        raise DegenerateDataError(
            f"expected at least {_LEAST_VIEWS} pictures with {LEAST_MARKERS} markers of the print, got {len(rich)} of {len(views)}; drive nearer, or "
            "print larger markers"
        )
    problem = _Problem(views, corners_m, pinhole)
    found = min(
        (problem.fit(start) for start in _starts(rich, corners_m, pinhole)), key=lambda each: each.cost
    )
    noise = max(2.0 * found.cost / max(1, found.fun.size - 8), LEAST_NOISE_PX**2)
    rms_px = float(np.sqrt(np.mean(found.fun**2) * 2.0))
    extent_px = float(np.median([np.ptp(_pixels(each), axis=0).max() for each in rich]))
    most_px = max(_MOST_RMS_PX, _MOST_RMS_SHARE * extent_px)
    if rms_px > most_px:
        raise PoorFitError(
            f"expected corners within {most_px:.1f} px of where the camera poses put them, got {rms_px:.1f} px; are the camera's mount and latency_s those "
            "of this car, and did the print stand still?"
        )
    covariance = noise * CORRELATED**2 * np.linalg.pinv(found.jac.T @ found.jac)
    angle_sd = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    scale_sd = float(np.sqrt(covariance[6, 6]))
    if angle_sd > MOST_ANGLE_RAD or scale_sd > MOST_SHARE:
        raise DegenerateDataError(
            f"expected pictures that give the direction within {np.degrees(MOST_ANGLE_RAD):.1f} degrees and the size within {100 * MOST_SHARE:.1f} %, got "
            f"{np.degrees(angle_sd):.2f} degrees and {100 * scale_sd:.2f} % from {len(views)} pictures; drive past it at several distances and angles"
        )
    flatness_m, flatness_sd_m = problem.flatness(found.x, noise)
    scale = float(np.exp(found.x[6]))
    return PlacedPrint(
        scale,
        scale_sd,
        make_transform(cv2.Rodrigues(found.x[:3])[0], found.x[3:6]),
        angle_sd,
        rms_px,
        flatness_m,
        flatness_sd_m,
        {number: scale * off for number, off in problem.shift_lengths_m(found.x).items()},
        len(views),
    )


class _Problem:
    """Errors of all corners [px] over rotation vector, translation [m], logarithm of the scale, and growth of the black."""

    def __init__(self, views: Sequence[PrintView], corners_m: Mapping[int, Array], pinhole: Pinhole) -> None:
        self._pinhole = pinhole
        self.numbers = sorted({number for view in views for number in view.markers})
        index = {number: k for k, number in enumerate(self.numbers)}
        pairs = [(view, number) for view in views for number in view.markers]
        self._seen = [number for _, number in pairs]
        self._which = np.array([index[number] for _, number in pairs])
        self._pixels = np.stack([view.markers[number] for view, number in pairs])
        cameras = np.stack([invert_transform(view.T_world_from_camera) for view, _ in pairs])
        self._R, self._t = cameras[:, :3, :3], cameras[:, :3, 3]
        self._points = np.stack([corners_m[number] for number in self.numbers])
        self._middles = self._points.mean(axis=1, keepdims=True)

    def errors(self, p: Array, off_m: Array | float = 0.0) -> Array:
        grown = np.exp(p[6]) * (self._middles + (1.0 + p[7]) * (self._points - self._middles)) + off_m
        world = grown @ cv2.Rodrigues(p[:3])[0].T + p[3:6]
        seen = np.einsum("nij,nkj->nki", self._R, world[self._which]) + self._t[:, None]
        return np.asarray((self._pinhole.project(seen) - self._pixels).ravel())

    def fit(self, start: Array) -> Any:
        return least_squares(self.errors, start, x_scale="jac", loss="soft_l1", f_scale=2.0, max_nfev=60)

    def shift_lengths_m(self, p: Array) -> dict[int, float]:
        """See `print_model.shift_lengths_m`."""
        scale = np.exp(p[6])
        return shift_lengths_m(lambda shift: self.errors(p, scale * shift).reshape(-1, 4, 2), self._seen)

    def flatness(self, p: Array, noise: float) -> tuple[float, float]:
        """Root mean square distance of the markers from their own plane, and the standard deviation of one [m]."""
        normal = np.array([1.0, 0.0, 0.0])
        found = least_squares(
            lambda off: self.errors(p, off[:, None, None] * normal), np.zeros(len(self.numbers)), method="lm"
        )
        variances = noise * CORRELATED**2 * np.diag(np.linalg.pinv(found.jac.T @ found.jac))
        plane = np.concatenate([self._middles[:, 0, 1:], np.ones((len(self.numbers), 1))], axis=1)
        off = found.x - plane @ np.linalg.lstsq(plane, found.x, rcond=None)[0]
        return float(np.sqrt(np.mean(off**2))), float(np.sqrt(variances.mean()))


def _starts(views: Sequence[PrintView], corners_m: Mapping[int, Array], pinhole: Pinhole) -> list[Array]:
    """First values from the directions of single pictures; size and place from all of them: the print is where all see its middle."""
    poses = [some_pose(view.markers, corners_m, pinhole) for view in views]
    cameras = [view.T_world_from_camera for view in views]
    away = np.stack([T[:3, :3] @ pose[:3, 3] for T, pose in zip(cameras, poses, strict=True)])
    places = np.stack([T[:3, 3] for T in cameras])
    rows = np.concatenate([np.tile(np.eye(3), (len(views), 1)), -away.reshape(-1, 1)], axis=1)
    *middle, scale = np.linalg.lstsq(rows, places.ravel(), rcond=None)[0]
    scale = float(scale) if scale > 0.05 else 1.0
    chosen = np.unique(np.linspace(0, len(views) - 1, _STARTS).round().astype(int))
    starts = []
    for k in chosen:
        R = cameras[k][:3, :3] @ poses[k][:3, :3]
        starts.append(np.concatenate([cv2.Rodrigues(R)[0].ravel(), middle, [np.log(scale), 0.0]]))
    return starts


def _pixels(view: PrintView) -> Array:
    return np.concatenate(list(view.markers.values()))
