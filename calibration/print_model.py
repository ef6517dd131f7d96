"""Corners of a print's markers in a photograph, as a function of its pose, and of what may be wrong with it: growth, aspect and bend.

A print on a wall is nearly flat. Its bend is three numbers with a prior: if it were fixed at none, a bent print would get a wrong direction
with a small standard deviation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.optimize import least_squares

from advnerf_core.geometry import Array, Pinhole, make_transform, transform_points

# Places of the parameters: pose (rotation vector, translation), growth of the black, logarithm of the aspect, bend.
POSE, GROWTH, ASPECT, BEND = slice(0, 6), 6, 7, slice(8, 11)
COUNT = 11
RIGID = tuple(range(7))
BENT = (*RIGID, 8, 9, 10)
_STEP_M = 1e-4  # of differences: pixels are nearly linear over such a shift
# Corners of one marker share the errors of its edges: standard deviations for independent errors are multiplied by this.
CORRELATED = 2.0
LEAST_NOISE_PX = 0.05
_BEND_SHARE, _USUAL_NOISE_PX = 0.04, 0.2  # standard deviation of a bend, as a share of half the print's side

Errors = Callable[[Array], Array]
"""Errors ``[N, 4, 2]`` [px] of the corners over the parameters."""


@dataclass(frozen=True, eq=False)
class PrintFit:
    """Fitted parameters.

    Attributes:
        values: The parameters ``[P]``.
        covariance: Their covariance ``[P, P]``; 0 of those that were not free.
        errors_px: Errors ``[N, 4, 2]`` of the corners [px].
        cost: Sum of squares, with the prior's.
    """

    values: Array
    covariance: Array
    errors_px: Array
    cost: float

    @property
    def rms_px(self) -> float:
        """Root mean square distance of the corners from their projections [px]."""
        return float(np.sqrt(np.mean(self.errors_px**2) * 2.0))

    @property
    def transform(self) -> Array:
        """The pose ``[4, 4]``."""
        return make_transform(cv2.Rodrigues(self.values[:3])[0], self.values[3:6])

    def sd(self, index: int) -> float:
        """Standard deviation of a parameter."""
        return float(np.sqrt(self.covariance[index, index]))

    @property
    def angle_sd_rad(self) -> float:
        """Largest standard deviation of the rotation about an axis [rad]."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))


def corner_errors(markers: Mapping[int, Array], corners_m: Mapping[int, Array], pinhole: Pinhole) -> Errors:
    """Errors of the corners of seen markers over the parameters.

    Args:
        markers: Corners ``[4, 2]`` of the markers in the photograph by number [px].
        corners_m: Nominal corners ``[4, 3]`` of all markers of the print [m].
        pinhole: Intrinsics of the undistorted photograph.
    """
    points = np.stack([corners_m[number] for number in markers])
    pixels = np.stack(list(markers.values()))
    middles, half_m = points.mean(axis=1, keepdims=True), half_side(corners_m)

    def errors(p: Array) -> Array:
        grown = middles + (1.0 + p[GROWTH]) * (points - middles)
        laid = _laid_out(grown, p[ASPECT], bend_m(p[BEND], points / half_m))
        return pinhole.project(moved(p, laid)) - pixels

    return errors


def shift_lengths_m(errors: Callable[[Array], Array], numbers: Sequence[int]) -> dict[int, float]:
    """How far each marker lies from its place in the print's plane, by its number, in nominal metres.

    Args:
        errors: Errors ``[N, 4, 2]`` [px] of seen markers over a shift ``[3]`` of all of them on the print [m].
        numbers: Numbers of these N markers; one that is seen several times has the shift that explains it best.
    """
    here, *beyond = (errors(_STEP_M * np.array(way)) for way in ((0, 0, 0), (0, 1, 0), (0, 0, 1)))
    slopes = np.stack([(each - here) / _STEP_M for each in beyond], axis=-1)
    found = {}
    for number in sorted(set(numbers)):
        those = np.array(numbers) == number
        shift = np.linalg.lstsq(slopes[those].reshape(-1, 2), here[those].ravel(), rcond=None)[0]
        found[number] = float(np.linalg.norm(shift))
    return found


@dataclass(frozen=True, eq=False)
class LaidPrint:
    """How a print lies before the camera, with what is wrong with it: its points are not where the nominal ones of its pose are.

    Attributes:
        T_camera_from_face: Pose ``[4, 4]`` of the print's middle plane, in nominal units.
        log_aspect: Logarithm of its aspect over the nominal one.
        bend: Parameters ``[3]`` of `bend_m`.
        half_m: `half_side` of its markers.
    """

    T_camera_from_face: Array
    log_aspect: float = 0.0
    bend: Array = field(default_factory=lambda: np.zeros(3))
    half_m: float = 1.0

    def in_camera(self, points_m: Array) -> Array:
        """Points of the print ``[..., 3]``, nominal, in the camera's frame."""
        laid = _laid_out(points_m, self.log_aspect, bend_m(self.bend, points_m / self.half_m))
        return transform_points(self.T_camera_from_face, laid.reshape(-1, 3)).reshape(points_m.shape)


def _laid_out(points_m: Array, log_aspect: float, bent_m: Array) -> Array:
    """Points ``[..., 3]`` of a flat print, stretched by its aspect and moved off its plane by ``[...]`` [m]."""
    laid = points_m * np.exp([0.0, 0.5 * log_aspect, -0.5 * log_aspect])
    laid[..., 0] = bent_m
    return laid


def half_side(corners_m: Mapping[int, Array]) -> float:
    """Half of the longer side of all markers together [m]."""
    return float(0.5 * np.ptp(np.concatenate(list(corners_m.values())), axis=0).max())


def bend_m(bend: Array, shares: Array) -> Array:
    """Distance from the middle plane ``[...]`` [m] at points ``[..., 3]`` in half sides, of a bend ``[3]``: along y, across, along z [m]."""
    y, z = shares[..., 1], shares[..., 2]
    return np.asarray(bend[0] * (y * y - 1.0 / 3.0) + bend[1] * y * z + bend[2] * (z * z - 1.0 / 3.0))


def fit_parameters(errors: Errors, start: Array, free: Sequence[int], half_m: float) -> PrintFit:
    """Least squares over the free parameters; a free bend has its prior.

    Args:
        errors: Errors over all parameters.
        start: First values ``[P]``.
        free: Places of the free parameters.
        half_m: See `half_side`.
    """
    chosen, shape = list(free), errors(start).shape
    bent = BEND.start in chosen

    def complete(values: Array) -> Array:
        found = start.copy()
        found[chosen] = values
        return found

    def residuals(values: Array) -> Array:
        p = complete(values)
        prior = p[BEND] * (_USUAL_NOISE_PX / (_BEND_SHARE * half_m)) if bent else np.zeros(0)
        return np.concatenate([errors(p).ravel(), prior])

    found = least_squares(residuals, start[chosen], x_scale="jac", method="lm")
    corners = found.fun[: int(np.prod(shape))]
    variance = max(float(corners @ corners) / max(1, corners.size - len(chosen)), LEAST_NOISE_PX**2)
    covariance = np.zeros((len(start), len(start)))
    covariance[np.ix_(chosen, chosen)] = variance * CORRELATED**2 * np.linalg.pinv(found.jac.T @ found.jac)
    return PrintFit(complete(found.x), covariance, corners.reshape(shape), float(found.fun @ found.fun))


def moved(p: Array, points: Array) -> Array:
    """Points ``[..., 3]`` of the print in the camera's frame."""
    return np.asarray(points @ cv2.Rodrigues(p[:3])[0].T + p[3:6])


def parameters(T: Array) -> Array:
    """Parameters ``[11]`` of a flat print of nominal shape at a pose ``[4, 4]``."""
    found = np.zeros(COUNT)
    found[:3], found[3:6] = cv2.Rodrigues(np.ascontiguousarray(T[:3, :3]))[0].ravel(), T[:3, 3]
    return found
