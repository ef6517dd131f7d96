"""Linear least squares with standard deviations of the coefficients."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array
from calibration.degeneracy import DegenerateDataError


def linear_fit(rows: Array, values: Array) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Fit ``rows @ coefficients = values``.

    Args:
        rows: ``[N, k]``.
        values: ``[N]``.

    Returns:
        The k coefficients, and their standard deviations by the residuals.

    Raises:
        DegenerateDataError: The columns are not independent.
    """
    found, _, rank, _ = np.linalg.lstsq(rows, values, rcond=None)
    left = values - rows @ found
    freedom = max(len(values) - rows.shape[1], 1)
    covariance = np.linalg.pinv(rows.T @ rows) * float(left @ left) / freedom
    if rank < rows.shape[1]:
        raise DegenerateDataError(
            "expected commands that differ, got the same everywhere, so gain and offset cannot be separated; vary the commands"
        )
    return tuple(float(v) for v in found), tuple(float(v) for v in np.sqrt(np.diag(covariance)))


def line_stddev(x: Array, y: Array, slope: float, at_zero: float, where: float) -> float:
    """Standard deviation of the line ``y = slope x + at_zero`` fitted to points ``[N]``, at the place ``where``."""
    left: NDArray[np.float64] = y - slope * x - at_zero
    variance = float(left @ left) / max(len(x) - 2, 1)
    spread = float(np.sum((x - x.mean()) ** 2))
    return float(np.sqrt(variance * (1.0 / len(x) + (where - x.mean()) ** 2 / spread)))
