"""CPU kernels that walk rays through a box, leap over empty space and place samples in occupied space.

Rays live in box coordinates: positions are metres divided by the longest side of the box, measured from its low corner, so the box
is ``[0, high]`` with ``max(high) = 1``; the ray parameter stays in metres. ``distance`` gives per cell the number of cells that are free in any
direction: 0 is occupied, d > 0 means that all cells at Chebyshev distance below d are empty. With a contracted field the box is only the
inner region: rays continue outside it, and cells and sample positions refer to the unit cube that ``contraction`` maps all space to.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.parallel import KERNEL_OPTIONS
from advnerf_core.render.contraction import growing_step, into_cube, next_sample_contracted, span_before_far

Array32 = NDArray[np.float32]
Array8 = NDArray[np.uint8]

_f = np.float32
_FAR = np.float32(1e30)


@njit(**KERNEL_OPTIONS)
def _slab(origin, direction, high, near, far):  # type: ignore[no-untyped-def]
    """Clip a ray's span ``[near, far]`` to ``[0, high]`` along one axis."""
    if abs(direction) < _f(1e-12):
        return (near, far) if _f(0.0) <= origin <= high else (_FAR, -_FAR)
    a, b = -origin / direction, (high - origin) / direction
    return max(near, min(a, b)), min(far, max(a, b))


@njit(**KERNEL_OPTIONS)
def span_in_box(ray: Array32, high: Array32, near: np.float32) -> tuple[np.float32, np.float32]:
    """Ray parameters ``(start, end)`` [m] inside the box; ``start >= end`` if it misses. ``ray`` is origin and direction ``[6]``."""
    start, end = near, _FAR
    for axis in range(3):
        start, end = _slab(ray[axis], ray[3 + axis], high[axis], start, end)
    return start, end


@njit(**KERNEL_OPTIONS)
def _leap(position, direction, index, cells, reach):  # type: ignore[no-untyped-def]
    """Ray length to the edge of the empty block around cell ``index`` along one axis."""
    if direction > _f(1e-12):
        return (_f(index + reach) / cells - position) / direction
    if direction < _f(-1e-12):
        return (_f(index - reach + 1) / cells - position) / direction
    return _FAR


@njit(**KERNEL_OPTIONS)
def next_sample(ray: Array32, t: np.float32, end: np.float32, distance: Array8, cells: Array32) -> np.float32:
    """Ray parameter of the first occupied place at or after ``t``, or ``end`` or more without one.

    Args:
        ray: Origin and direction ``[6]`` in box coordinates.
        t: Ray parameter to start from [m].
        end: End of the ray in the box [m].
        distance: ``[X, Y, Z]``.
        cells: Cells per unit of box coordinates along each axis ``[3]``.
    """
    last_x, last_y, last_z = distance.shape[0] - 1, distance.shape[1] - 1, distance.shape[2] - 1
    while t < end:
        x, y, z = ray[0] + t * ray[3], ray[1] + t * ray[4], ray[2] + t * ray[5]
        i: Any = min(max(np.int32(x * cells[0]), 0), last_x)
        j: Any = min(max(np.int32(y * cells[1]), 0), last_y)
        k: Any = min(max(np.int32(z * cells[2]), 0), last_z)
        reach = np.int64(distance[i, j, k])
        if reach == 0:
            return t
        step = min(_leap(x, ray[3], i, cells[0], reach), _leap(y, ray[4], j, cells[1], reach))
        step = min(step, _leap(z, ray[5], k, cells[2], reach))
        t += max(step, _f(0.0)) + _f(
            1e-4
        )  # 0.1 mm into the next cell, so that rounding cannot trap a ray on an edge
    return t


@njit(**KERNEL_OPTIONS)
def step_size(t: np.float32, steps: Array32) -> np.float32:
    """Length [m] of the sample interval at ray parameter ``t``: ``clip(t * steps[2], steps[0], steps[1])``."""
    return min(max(t * steps[2], steps[0]), steps[1])


@njit(**KERNEL_OPTIONS)
def march(
    rays: Array32, jitter: Array32, first: int, stop: int, high: Array32, near: np.float32, steps: Array32,
    distance: Array8, cells: Array32, points: Array32, t_mid: Array32, widths: Array32, begins: NDArray[np.int64],
    max_samples: int, contracted: bool = False,
) -> int:  # fmt: skip
    """Place samples on rays ``first..stop`` until they end or the room for samples is used up.

    Args:
        rays: ``[R, 6]`` origins and unit directions in box coordinates.
        jitter: Position of a sample in its interval, ``[R]`` in [0, 1).
        first: First ray.
        stop: One past the last ray.
        high: High corner of the box ``[3]``.
        near: Nearest ray parameter [m].
        steps: Smallest and largest interval [m] and growth per metre ``[3]``.
        distance: Leap distances ``[X, Y, Z]``.
        cells: Cells per unit ``[3]``.
        points: Sample positions ``[capacity, 3]``, written; in the contracted cube if ``contracted``.
        t_mid: Ray parameter of each sample [m] ``[capacity]``, written.
        widths: Interval of each sample in box coordinates ``[capacity]``, written.
        begins: First sample of each ray, counted from ``first``'s, ``[stop - first + 1]``, written as far as rays fit.
        max_samples: Most samples on one ray.
        contracted: Whether the field is contracted.

    Returns:
        Number of rays that fit.
    """
    capacity, at = points.shape[0], 0
    for r in range(first, stop):
        ray = rays[r]
        begins[r - first] = at
        if at + max_samples > capacity:
            return r - first
        t, end = span_before_far(ray, near) if contracted else span_in_box(ray, high, near)
        limit = at + max_samples
        # Box units per metre along this ray: widths times densities must not depend on the unit of length.
        scale = np.sqrt(ray[3] * ray[3] + ray[4] * ray[4] + ray[5] * ray[5])
        while at < limit:
            if contracted:
                t = next_sample_contracted(ray, t, end, distance, cells)
            else:
                t = next_sample(ray, t, end, distance, cells)
            if t >= end:
                break
            width = growing_step(ray, t, steps) if contracted else step_size(t, steps)
            s = t + width * jitter[r]
            x, y, z = ray[0] + s * ray[3], ray[1] + s * ray[4], ray[2] + s * ray[5]
            if contracted:
                x, y, z = into_cube(x, y, z)
            points[at, 0], points[at, 1], points[at, 2] = x, y, z
            t_mid[at], widths[at] = s, width * scale
            at += 1
            t += width
    begins[stop - first] = at
    return stop - first
