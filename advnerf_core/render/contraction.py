"""Unbounded space in the unit cube: the piecewise projective contraction of Reiser et al. 2023, "MERF", and walks through it.

With ``y = 2 p - 1`` for box coordinates ``p``, so that the inner region is ``[-1, 1]^3``, and ``r`` the largest ``|y_j|``::

    c = y                                           where r <= 1
    c_a = sign(y_a) (2 - 1/r),  c_j = y_j / r       where axis a has the largest |y_a| = r > 1

and ``(c + 2) / 4`` in the unit cube. Unlike the contraction of Barron et al. 2022 ("Mip-NeRF 360"), it maps lines to lines within the
inner region and within each of the six outer ones. Cell faces are planes before as after it, so the way out of an empty block
is a division, as in a box, and a leap needs no bound on how much the contraction stretches. The price: the outer regions meet
the inner one seamlessly, but not each other, and corners of the cube, where two coordinates exceed 1, belong to no place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.parallel import KERNEL_OPTIONS

Array32 = NDArray[np.float32]
Array8 = NDArray[np.uint8]

FAR = 100.0
"""Rays end where the largest coordinate is this many half sides of the inner region; what is farther is background."""

_f = np.float32
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)
_NEVER = np.float32(1e30)
_FAR = np.float32(FAR)


def radial_stretch(shape: tuple[int, ...]) -> Array32:
    """Radial length of a grid's cells over the cube, relative to an inner cell: ``r^2``, at most the value at ``FAR``.

    Args:
        shape: Cells along each axis, multiples of 4, so that no cell lies in two regions.

    Returns:
        ``[X, Y, Z]``, 1 in the inner region, 0 where no place is mapped to.
    """
    sizes = [np.abs(4.0 * (np.arange(n) + 0.5) / n - 2.0) for n in shape]
    size = np.stack(np.meshgrid(*sizes, indexing="ij"))
    r = np.minimum(1.0 / (2.0 - np.maximum(size.max(axis=0), 1.0)), FAR)
    return np.where((size > 1.0).sum(axis=0) > 1, 0.0, r * r).astype(np.float32)


def bounded_distances(t: Array32, widths: Array32) -> tuple[Array32, Array32]:
    """Ray parameters and intervals in box sides ``[N]`` brought to ``[0, 2)``: ``t`` up to one side, ``2 - 1/t`` beyond it.

    The distortion loss compares these: two metres of fog matter near a camera, and not on the horizon.
    """
    far = np.maximum(t, _ONE)
    return np.where(t <= _ONE, t, _TWO - _ONE / far).astype(np.float32), (widths / (far * far)).astype(
        np.float32
    )


@njit(**KERNEL_OPTIONS)
def into_cube(x, y, z):  # type: ignore[no-untyped-def]
    """One point in box coordinates, anywhere, to the unit cube."""
    x, y, z = _TWO * x - _ONE, _TWO * y - _ONE, _TWO * z - _ONE
    ax, ay, az = abs(x), abs(y), abs(z)
    r = max(ax, ay, az)
    if r > _ONE:
        inverse = _ONE / r
        longer = _TWO - inverse
        if ax == r:
            x, y, z = np.copysign(longer, x), y * inverse, z * inverse
        elif ay == r:
            x, y, z = x * inverse, np.copysign(longer, y), z * inverse
        else:
            x, y, z = x * inverse, y * inverse, np.copysign(longer, z)
    half, quarter = _f(0.5), _f(0.25)
    return quarter * x + half, quarter * y + half, quarter * z + half


@njit(**KERNEL_OPTIONS)
def span_before_far(ray: Array32, near: np.float32) -> tuple[np.float32, np.float32]:
    """Ray parameters ``(start, end)`` [m] nearer than ``FAR``; ``start >= end`` if there are none. ``ray`` is ``[6]``."""
    start, end = near, _NEVER
    for axis in range(3):
        o, d = _TWO * ray[axis] - _ONE, _TWO * ray[3 + axis]
        if abs(d) < _f(1e-12):
            if abs(o) > _FAR:
                end = -_NEVER
            continue
        a, b = (-_FAR - o) / d, (_FAR - o) / d
        start, end = max(start, min(a, b)), min(end, max(a, b))
    return start, end


@njit(**KERNEL_OPTIONS)
def growing_step(ray: Array32, t: np.float32, steps: Array32) -> np.float32:
    """Length [m] of the sample interval at ``t``: as ``step_size``, with a largest one that outside grows like the cells, by ``r^2``."""
    r = _ONE
    for axis in range(3):
        r = max(r, abs(_TWO * (ray[axis] + t * ray[3 + axis]) - _ONE))
    return min(max(t * steps[2], steps[0]), steps[1] * r * r)


@njit(**KERNEL_OPTIONS)
def _until(value, slope):  # type: ignore[no-untyped-def]
    """When ``value + t slope``, not negative now, becomes so."""
    return max(value, _ZERO) / -slope if slope < _f(-1e-20) else _NEVER


@njit(**KERNEL_OPTIONS)
def _way_out_inside(y, d, low, high):  # type: ignore[no-untyped-def]
    """Along one axis in the inner region: to the faces of the block, or of the region."""
    return min(_until(min(high, _ONE) - y, -d), _until(y - max(low, -_ONE), d))


@njit(**KERNEL_OPTIONS)
def _way_out_along(y, d, low, high):  # type: ignore[no-untyped-def]
    """Along the largest axis of an outer region: to the faces at distances ``1 / (2 - c)``."""
    if y < _ZERO:
        y, d, low, high = -y, -d, -high, -low
    farthest = _ONE / (_TWO - high) if high < _f(1.9999) else _NEVER
    return min(_until(farthest - y, -d), _until(y - _ONE / (_TWO - max(low, _ONE)), d))


@njit(**KERNEL_OPTIONS)
def _way_out_across(y, d, r, dr, low, high):  # type: ignore[no-untyped-def]
    """Along another axis of an outer region: to the slanted faces ``y = c r``."""
    low, high = max(low, -_ONE), min(high, _ONE)
    return min(_until(high * r - y, high * dr - d), _until(y - low * r, d - low * dr))


@njit(**KERNEL_OPTIONS)
def leap_contracted(ray: Array32, t: np.float32, distance: Array8, cells: Array32) -> np.float32:
    """The ray parameter [m] behind the empty block around ``t``; ``t`` itself in an occupied cell.

    Args:
        ray: Origin and direction ``[6]`` in box coordinates.
        t: Ray parameter [m].
        distance: Leap distances over the contracted cube ``[X, Y, Z]``.
        cells: Cells per unit of the cube along each axis ``[3]``.
    """
    last_x, last_y, last_z = distance.shape[0] - 1, distance.shape[1] - 1, distance.shape[2] - 1
    px, py, pz = ray[0] + t * ray[3], ray[1] + t * ray[4], ray[2] + t * ray[5]
    gx, gy, gz = into_cube(px, py, pz)
    i: Any = min(max(np.int32(gx * cells[0]), 0), last_x)
    j: Any = min(max(np.int32(gy * cells[1]), 0), last_y)
    k: Any = min(max(np.int32(gz * cells[2]), 0), last_z)
    reach = np.int64(distance[i, j, k])
    if reach == 0:
        return t
    dx, dy, dz = _TWO * ray[3], _TWO * ray[4], _TWO * ray[5]
    wide_x, wide_y, wide_z = _f(4.0) / cells[0], _f(4.0) / cells[1], _f(4.0) / cells[2]
    x, y, z = _TWO * px - _ONE, _TWO * py - _ONE, _TWO * pz - _ONE
    low_x, high_x = _f(i - reach + 1) * wide_x - _TWO, _f(i + reach) * wide_x - _TWO
    low_y, high_y = _f(j - reach + 1) * wide_y - _TWO, _f(j + reach) * wide_y - _TWO
    low_z, high_z = _f(k - reach + 1) * wide_z - _TWO, _f(k + reach) * wide_z - _TWO
    ax, ay, az = abs(x), abs(y), abs(z)
    r = max(ax, ay, az)
    if r <= _ONE:
        step = min(_way_out_inside(x, dx, low_x, high_x), _way_out_inside(y, dy, low_y, high_y))
        step = min(step, _way_out_inside(z, dz, low_z, high_z))
    elif ax == r:
        dr = np.copysign(dx, x * dx)
        step = min(_way_out_along(x, dx, low_x, high_x), _way_out_across(y, dy, r, dr, low_y, high_y))
        step = min(step, _way_out_across(z, dz, r, dr, low_z, high_z))
    elif ay == r:
        dr = np.copysign(dy, y * dy)
        step = min(_way_out_along(y, dy, low_y, high_y), _way_out_across(z, dz, r, dr, low_z, high_z))
        step = min(step, _way_out_across(x, dx, r, dr, low_x, high_x))
    else:
        dr = np.copysign(dz, z * dz)
        step = min(_way_out_along(z, dz, low_z, high_z), _way_out_across(x, dx, r, dr, low_x, high_x))
        step = min(step, _way_out_across(y, dy, r, dr, low_y, high_y))
    # Into the next cell, so that rounding, which grows with distance, cannot trap a ray on a face.
    return t + (step + _f(1e-4) + _f(2e-5) * t)


@njit(**KERNEL_OPTIONS)
def next_sample_contracted(
    ray: Array32, t: np.float32, end: np.float32, distance: Array8, cells: Array32
) -> np.float32:
    """``next_sample`` on a grid over the contracted cube; arguments as in `leap_contracted`, and the ray's ``end`` [m]."""
    while t < end:
        further = leap_contracted(ray, t, distance, cells)
        if further == t:
            return t
        t = further
    return t
