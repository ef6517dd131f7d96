"""The CPU kernel that evaluates a splat at points: density and colour of the volume that looks like the Gaussians.

A Gaussian with opacity ``o`` shows as ``alpha = o G`` in an image. The volume whose optical depth along a ray through it is
``-log(1 - o G)`` has the density ``Li_1/2(o G) / (sqrt(2 pi) s)``, with the polylogarithm ``Li`` and the deviation ``s`` along the ray: term
by term, the Gaussian ``G^n`` has the integral ``sqrt(2 pi / n) s``. Here ``s`` is the smallest deviation, as a leaf is seen from its front.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.parallel import KERNEL_OPTIONS
from advnerf_core.scene.baked_kernels import LOG_STEP, LOWEST_LOG
from advnerf_core.splats.projection import MOST_ALPHA

Array32 = NDArray[np.float32]
Array32i = NDArray[np.int32]

CELLS, LEVELS = (
    256,
    9,
)  # along the longest side of the finest grid of lists; each level has half as many as the one before
MOST_Q = 14.0  # squared Mahalanobis distance beyond which a Gaussian's density is nothing
_STEPS = 512  # of the table
_f = np.float32
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


def profile_table() -> Array32:
    """``Li_1/2(x) / x`` at ``_STEPS + 1`` values of ``x`` from 0 to the largest opacity."""
    x = np.linspace(0.0, MOST_ALPHA, _STEPS + 1)
    n = np.arange(1.0, 1500.0)[:, None]
    return np.asarray((x ** (n - 1.0) / np.sqrt(n)).sum(axis=0), np.float32)


@njit(**KERNEL_OPTIONS)
def evaluate_gaussians(
    points: Array32, first: int, stop: int, means: Array32, inverses: Array32, amplitudes: Array32, opacities: Array32, colours: Array32,
    begins: Array32i, lists: Array32i, table: Array32, values: NDArray[np.uint8], log_density: Array32,
) -> None:  # fmt: skip
    """Density and colour at the points ``first..stop``.

    Args:
        points: ``[P, 3]`` in box coordinates.
        first: First point.
        stop: One past the last.
        means: ``[N, 3]`` in box coordinates.
        inverses: Inverse covariances, widened to the spacing of points ``[N, 6]``.
        amplitudes: Density of the first term per box side ``[N]``.
        opacities: ``[N]``, at most the largest that is drawn.
        colours: ``[N, 3]`` in 0..1.
        begins: First entry of each cell of all levels in ``lists`` ``[cells + 1]``.
        lists: Gaussians of the cells.
        table: From `profile_table`.
        values: ``[P, 4]`` as `Voxels` holds them, written.
        log_density: ``[P]``, written.
    """
    scale = _f(_STEPS / MOST_ALPHA)
    for p in range(first, stop):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        total, red, green, blue = _f(1e-20), _ZERO, _ZERO, _ZERO
        offset: Any = np.int64(0)
        cells: Any = np.int64(CELLS)
        for _ in range(LEVELS):
            i: Any = min(max(np.int64(x * _f(cells)), 0), cells - 1)
            j: Any = min(max(np.int64(y * _f(cells)), 0), cells - 1)
            k: Any = min(max(np.int64(z * _f(cells)), 0), cells - 1)
            cell = offset + (i * cells + j) * cells + k
            for at in range(begins[cell], begins[cell + 1]):
                n = lists[at]
                dx, dy, dz = x - means[n, 0], y - means[n, 1], z - means[n, 2]
                s = inverses[n]
                q = (
                    s[0] * dx * dx
                    + s[3] * dy * dy
                    + s[5] * dz * dz
                    + _f(2.0) * (s[1] * dx * dy + s[2] * dx * dz + s[4] * dy * dz)
                )
                if q > _f(MOST_Q):
                    continue
                shown = opacities[n] * np.exp(-_HALF * max(q, _ZERO))
                place = shown * scale
                step: Any = min(np.int64(place), _STEPS - 1)
                part = place - _f(step)
                density = amplitudes[n] * shown * (table[step] * (_ONE - part) + table[step + 1] * part)
                total += density
                red += density * colours[n, 0]
                green += density * colours[n, 1]
                blue += density * colours[n, 2]
            offset += cells * cells * cells
            cells //= 2
        log_density[p] = np.log(total)
        level = (log_density[p] - _f(LOWEST_LOG)) / _f(LOG_STEP)
        values[p, 0] = np.uint8(min(max(level, _ZERO), _f(255.0)) + _HALF)
        values[p, 1] = np.uint8(min(red / total, _ONE) * _f(255.0) + _HALF)
        values[p, 2] = np.uint8(min(green / total, _ONE) * _f(255.0) + _HALF)
        values[p, 3] = np.uint8(min(blue / total, _ONE) * _f(255.0) + _HALF)


@njit(**KERNEL_OPTIONS)
def _from_to(low, high, cells):  # type: ignore[no-untyped-def]
    """First and last cell of a stretch along one axis."""
    first, last = np.int64(np.floor(low * _f(cells))), np.int64(np.floor(high * _f(cells)))
    return max(first, 0), min(last, cells - 1)


@njit(**KERNEL_OPTIONS)
def list_cells(low: Array32, high: Array32, begins: Array32i, lists: Array32i, counting: bool) -> None:
    """Count the Gaussians of each cell, or write them into the lists.

    A Gaussian is listed at the finest level where its reach is at most three cells long, so in few cells.

    Args:
        low: Low corner of each Gaussian's reach in box coordinates ``[N, 3]``.
        high: High corner ``[N, 3]``.
        begins: Counting: one past each cell's place, its count is added ``[cells + 1]``. Else: next free entry of each cell, moved on.
        lists: Written, unless counting.
        counting: Whether samples are only counted.
    """
    for n in range(low.shape[0]):
        reach = max(high[n, 0] - low[n, 0], max(high[n, 1] - low[n, 1], high[n, 2] - low[n, 2]))
        if not (
            min(high[n, 0], min(high[n, 1], high[n, 2])) >= _ZERO
            and max(low[n, 0], max(low[n, 1], low[n, 2])) <= _ONE
        ):
            continue
        offset: Any = np.int64(0)
        cells: Any = np.int64(CELLS)
        level = 0
        while level < LEVELS - 1 and reach * _f(cells) > _f(3.0):
            offset += cells * cells * cells
            cells //= 2
            level += 1
        i0, i1 = _from_to(low[n, 0], high[n, 0], cells)
        j0, j1 = _from_to(low[n, 1], high[n, 1], cells)
        k0, k1 = _from_to(low[n, 2], high[n, 2], cells)
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                for k in range(k0, k1 + 1):
                    cell = offset + (i * cells + j) * cells + k
                    if counting:
                        begins[cell + 1] += 1
                    else:
                        lists[begins[cell]] = n
                        begins[cell] += 1
