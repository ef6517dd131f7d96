"""Errors and checks for measurements that do not determine a result, even if their residuals are small."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from advnerf_core.geometry import Array, make_transform
from calibration.schema import CalibrationError


class DegenerateDataError(CalibrationError):
    """The data do not determine the result. The message says why and what to record instead."""


class PoorFitError(CalibrationError):
    """The data determine the result, but the fit is too poor to be used."""


def mean_rotation(rotations: ArrayLike) -> Array:
    """Chordal mean ``[3, 3]`` of rotations ``[N, 3, 3]``: the rotation nearest to their arithmetic mean."""
    u, _, vt = np.linalg.svd(np.asarray(rotations, np.float64).mean(axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def mean_transform(T: Array) -> Array:
    """Mean ``[4, 4]`` of the rotations and of the positions of poses ``[N, 4, 4]``."""
    return make_transform(mean_rotation(T[:, :3, :3]), T[:, :3, 3].mean(axis=0))


def rotation_spread(rotations: ArrayLike) -> Array:
    """Root mean square turn about the three principal axes ``[3]`` [rad], largest first, of rotations ``[N, 3, 3]``.

    Rotations about one axis alone, as of a car on a floor, have a second value at their noise.
    """
    R = np.asarray(rotations, np.float64)
    turns = Rotation.from_matrix(mean_rotation(R).T @ R).as_rotvec()
    return np.asarray(np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(R)))


def require_count(found: int, needed: int, what: str, cure: str) -> None:
    """Raise `DegenerateDataError` if there are too few measurements."""
    if found < needed:
        raise DegenerateDataError(f"expected at least {needed} {what}, got {found}: {cure}")
