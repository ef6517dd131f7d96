"""The likelihood of all corners of all views as a function of a camera's mounting pose; see `calibration.camera_to_car`."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from advnerf_core.geometry import Array, invert_transform, make_transform
from calibration.charuco import Detection

# Standard deviation of a corner's position, per axis [px].
_CORNER_STDDEV_PX = 0.15
# Standard deviation of a body's position from motion capture, per axis [m].
_MOCAP_STDDEV_M = 0.0005
# Standard deviation of its rotation, per axis [rad].
_MOCAP_STDDEV_RAD = 0.001


class MountProblem:
    """The whitened reprojection error of all corners as a function of X, and of Y if it is unknown."""

    def __init__(
        self,
        T_base_from_car: Array,
        found: Sequence[Detection],
        matrix: Array,
        distortion: Array,
        known: Array | None,
    ) -> None:
        self._T_base_from_car, self._found = T_base_from_car, found
        self._matrix, self._distortion, self._known = matrix, distortion, known

    def solve(self, X: Array, Y: Array, inside: NDArray[np.bool_]) -> tuple[Array, Array, float, float]:
        """Refined X and Y, and the standard deviations of X's rotation [rad] and translation [m]."""
        found, covariance = self._fit(X, Y, inside, with_stretch=False)
        turn, move = (np.sqrt(np.linalg.eigvalsh(covariance[a : a + 3, a : a + 3])[-1]) for a in (0, 3))
        return *self._moved(X, Y, found), float(turn), float(move)

    def stretch(self, X: Array, Y: Array, inside: NDArray[np.bool_]) -> tuple[float, float]:
        """Factor by which the board looks larger than it is said to be, minus 1, and its standard deviation."""
        found, covariance = self._fit(X, Y, inside, with_stretch=True)
        return float(found[-1]), float(np.sqrt(covariance[-1, -1]))

    def _fit(self, X: Array, Y: Array, inside: NDArray[np.bool_], with_stretch: bool) -> tuple[Array, Array]:
        """Parameters of the best fit near X and Y, the board's stretch last if it is one of them, and their covariance."""
        rows = np.flatnonzero(inside)
        factors = [self._factor(X, Y, row) for row in rows]

        def residuals(p: Array) -> Array:
            A, B = self._moved(X, Y, p)
            larger = 1.0 + p[-1] if with_stretch else 1.0
            each = (self._errors(A, B, row, larger=larger).ravel() for row in rows)
            return np.concatenate(
                [solve_triangular(f, e, lower=True) for f, e in zip(factors, each, strict=True)]
            )

        size = (6 if self._known is not None else 12) + with_stretch
        found = least_squares(residuals, np.zeros(size), x_scale="jac")
        # Scaled by the residuals, so that a larger noise than stated is not hidden.
        scale = 2.0 * found.cost / (len(found.fun) - size)
        return found.x, np.linalg.pinv(found.jac.T @ found.jac) * max(scale, 1.0)

    def view_rms(self, X: Array, Y: Array) -> Array:
        """Reprojection error of each view ``[N]`` [px]."""
        count = len(self._found)
        return np.array(
            [np.sqrt(np.mean(np.sum(self._errors(X, Y, row) ** 2, axis=1))) for row in range(count)]
        )

    def _factor(self, X: Array, Y: Array, row: int) -> Array:
        """Lower Cholesky factor of the covariance of a view's corners ``[2n, 2n]``: from their own noise and both bodies' poses."""
        A = self._T_base_from_car[row]
        here = self._errors(X, Y, row).ravel()
        covariance = _CORNER_STDDEV_PX**2 * np.eye(len(here))
        step = 1e-6
        for axis in range(6):
            p = np.zeros(6)
            p[axis] = step
            stddev = _MOCAP_STDDEV_RAD if axis < 3 else _MOCAP_STDDEV_M
            # The car's frame moves, then the board's.
            for moved in (A @ small_motion(p), small_motion(p) @ A):
                slope = (self._errors(X, Y, row, moved).ravel() - here) / step * stddev
                covariance += np.outer(slope, slope)
        return np.asarray(np.linalg.cholesky(covariance))

    def _moved(self, X: Array, Y: Array, p: Array) -> tuple[Array, Array]:
        return X @ small_motion(p[:6]), Y if self._known is not None else Y @ small_motion(p[6:12])

    def _errors(
        self, X: Array, Y: Array, row: int, T_base_from_car: Array | None = None, larger: float = 1.0
    ) -> Array:
        A = self._T_base_from_car[row] if T_base_from_car is None else T_base_from_car
        T = invert_transform(A @ X) @ Y
        points = larger * self._found[row].board_m @ T[:3, :3].T + T[:3, 3]
        predicted = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self._matrix, self._distortion)[0]
        return np.asarray(predicted.reshape(-1, 2) - self._found[row].pixels)


def small_motion(p: Array) -> Array:
    """A transform ``[4, 4]`` of a rotation vector [rad] and a translation [m] ``[6]``."""
    return make_transform(Rotation.from_rotvec(p[:3]).as_matrix(), p[3:])
