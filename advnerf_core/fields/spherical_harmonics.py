"""Real spherical harmonics of viewing directions, up to degree 3, as network inputs.

Constants as in Sloan 2013, "Efficient spherical harmonic evaluation", appendix; ``bands`` b gives b^2 functions.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.parallel import KERNEL_OPTIONS

MAX_BANDS = 4


def spherical_harmonics(directions: Tensor, bands: int) -> Tensor:
    """Evaluate on unit directions.

    Args:
        directions: ``[..., 3]``, unit length.
        bands: Number of bands, 1..4.

    Returns:
        ``[..., bands^2]``, ordered by band.
    """
    if not 1 <= bands <= MAX_BANDS:
        raise ValueError(f"expected 1..{MAX_BANDS} bands, got {bands}")
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    values = [torch.full_like(x, 0.28209479177387814)]
    if bands > 1:
        values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if bands > 2:
        values += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (3.0 * zz - 1.0),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if bands > 3:
        values += [
            0.5900435899266435 * y * (yy - 3.0 * xx),
            2.890611442640554 * x * y * z,
            0.4570457994644658 * y * (1.0 - 5.0 * zz),
            0.3731763325901154 * z * (5.0 * zz - 3.0),
            0.4570457994644658 * x * (1.0 - 5.0 * zz),
            1.445305721320277 * z * (xx - yy),
            0.5900435899266435 * x * (3.0 * yy - xx),
        ]
    return torch.stack(values, dim=-1)


@njit(**KERNEL_OPTIONS)
def write_spherical_harmonics(
    x: np.float32, y: np.float32, z: np.float32, bands: int, out: NDArray[np.float32], row: int, column: int
) -> None:
    """The same for one unit direction, into ``out[row : row + bands^2, column]``."""
    f = np.float32
    out[row, column] = f(0.28209479177387814)
    if bands > 1:
        c = f(0.4886025119029199)
        out[row + 1, column], out[row + 2, column], out[row + 3, column] = -c * y, c * z, -c * x
    xx, yy, zz = x * x, y * y, z * z
    if bands > 2:
        c = f(1.0925484305920792)
        out[row + 4, column], out[row + 5, column] = c * x * y, -c * y * z
        out[row + 6, column] = f(0.31539156525252005) * (f(3.0) * zz - f(1.0))
        out[row + 7, column], out[row + 8, column] = -c * x * z, f(0.5462742152960396) * (xx - yy)
    if bands > 3:
        out[row + 9, column] = f(0.5900435899266435) * y * (yy - f(3.0) * xx)
        out[row + 10, column] = f(2.890611442640554) * x * y * z
        out[row + 11, column] = f(0.4570457994644658) * y * (f(1.0) - f(5.0) * zz)
        out[row + 12, column] = f(0.3731763325901154) * z * (f(5.0) * zz - f(3.0))
        out[row + 13, column] = f(0.4570457994644658) * x * (f(1.0) - f(5.0) * zz)
        out[row + 14, column] = f(1.445305721320277) * z * (xx - yy)
        out[row + 15, column] = f(0.5900435899266435) * x * (f(3.0) * yy - xx)
