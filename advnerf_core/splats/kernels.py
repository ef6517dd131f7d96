"""The CPU kernels of splat rendering: projection, lists of Gaussians by tile, and compositing front to back.

A tile sorts its Gaussians by depth bucket by bucket, and only as far as light comes through. What is drawn is decided without fused or
reordered arithmetic, so that plain torch makes the same decisions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.parallel import KERNEL_OPTIONS
from advnerf_core.splats.projection import DILATION_PX2, LEAST_TRANSMITTANCE, MOST_ALPHA

Array32 = NDArray[np.float32]
Array32i = NDArray[np.int32]
Array64i = NDArray[np.int64]

TILE = 16
# Columns of a projected Gaussian.
U, V, A, B2, C, Z, OPACITY, WITHIN, COLUMNS = 0, 1, 2, 3, 4, 5, 6, 7, 8
_BUCKETS = 512  # of depth, in a tile
_EXACT: dict[str, Any] = {**KERNEL_OPTIONS, "fastmath": False}

_f = np.float32
_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_DILATION, _MOST, _LEAST = np.float32(DILATION_PX2), np.float32(MOST_ALPHA), np.float32(LEAST_TRANSMITTANCE)
_SLACK_PX = np.float32(0.05)  # of a Gaussian's reach, for rounding


@njit(**_EXACT)
def project(
    first: int, stop: int, means: Array32, covariances: Array32, opacities: Array32, within: Array32, pose: Array32, lens: Array32,
    limits: Array32, near: np.float32, width: int, height: int, projected: Array32, source: Array32i, reach: NDArray[np.int16],
    counts: Array32i,
) -> int:  # fmt: skip
    """Project the Gaussians ``first..stop``; those that show in the image are written from place ``first`` on.

    Args:
        first: First Gaussian.
        stop: One past the last.
        means: ``[N, 3]`` [m].
        covariances: ``[N, 6]``, xx, xy, xz, yy, yz, zz [m^2].
        opacities: ``[N]``.
        within: From `drawn_within` ``[N]``.
        pose: Camera from world ``[3, 4]``.
        lens: ``fx, fy, cx, cy`` ``[4]``.
        limits: From `View` ``[4]``.
        near: Smallest depth [m].
        width: Width of the image [px].
        height: Height of the image [px].
        projected: ``[N, COLUMNS]``, written.
        source: The Gaussian at each place ``[N]``, written.
        reach: First and last tile along columns, then along rows ``[N, 4]``, written.
        counts: Gaussians in each tile ``[tiles]``, written.

    Returns:
        One past the last place that was written.
    """
    across = (width + TILE - 1) // TILE
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    at = first
    counts[:] = 0
    for n in range(first, stop):
        if within[n] <= _ZERO:
            continue
        mx, my, mz = means[n, 0], means[n, 1], means[n, 2]
        z = ((pose[2, 0] * mx + pose[2, 1] * my) + pose[2, 2] * mz) + pose[2, 3]
        if not z > near:
            continue
        x = ((pose[0, 0] * mx + pose[0, 1] * my) + pose[0, 2] * mz) + pose[0, 3]
        y = ((pose[1, 0] * mx + pose[1, 1] * my) + pose[1, 2] * mz) + pose[1, 3]
        tx, ty = min(max(x / z, limits[0]), limits[1]), min(max(y / z, limits[2]), limits[3])
        jx, jy = fx / z, fy / z
        jxz, jyz = jx * tx, jy * ty
        a0, b0 = jx * pose[0, 0] - jxz * pose[2, 0], jy * pose[1, 0] - jyz * pose[2, 0]
        a1, b1 = jx * pose[0, 1] - jxz * pose[2, 1], jy * pose[1, 1] - jyz * pose[2, 1]
        a2, b2 = jx * pose[0, 2] - jxz * pose[2, 2], jy * pose[1, 2] - jyz * pose[2, 2]
        s = covariances[n]
        sa0, sb0 = (s[0] * a0 + s[1] * a1) + s[2] * a2, (s[0] * b0 + s[1] * b1) + s[2] * b2
        sa1, sb1 = (s[1] * a0 + s[3] * a1) + s[4] * a2, (s[1] * b0 + s[3] * b1) + s[4] * b2
        sa2, sb2 = (s[2] * a0 + s[4] * a1) + s[5] * a2, (s[2] * b0 + s[4] * b1) + s[5] * b2
        xx = ((a0 * sa0 + a1 * sa1) + a2 * sa2) + _DILATION
        xy = (b0 * sa0 + b1 * sa1) + b2 * sa2
        yy = ((b0 * sb0 + b1 * sb1) + b2 * sb2) + _DILATION
        det = xx * yy - xy * xy
        if not det > _ZERO:
            continue
        u, v = (fx * x) / z + cx, (fy * y) / z + cy
        wide = np.sqrt(within[n] * xx) * _f(1.001) + _SLACK_PX
        high = np.sqrt(within[n] * yy) * _f(1.001) + _SLACK_PX
        if not (u + wide > _ZERO and u - wide < _f(width) and v + high > _ZERO and v - high < _f(height)):
            continue
        left, right = np.int64(max(u - wide, _ZERO)), np.int64(min(u + wide, _f(width - 1)))
        top, bottom = np.int64(max(v - high, _ZERO)), np.int64(min(v + high, _f(height - 1)))
        row = projected[at]
        row[U], row[V], row[A], row[B2], row[C] = u, v, yy / det, (_f(-2.0) * xy) / det, xx / det
        row[Z], row[OPACITY], row[WITHIN] = z, opacities[n], within[n]
        source[at] = n
        reach[at, 0], reach[at, 1], reach[at, 2], reach[at, 3] = (
            left // TILE,
            right // TILE,
            top // TILE,
            bottom // TILE,
        )
        for j in range(top // TILE, bottom // TILE + 1):
            for i in range(left // TILE, right // TILE + 1):
                counts[j * across + i] += 1
        at += 1
    return at


@njit(**KERNEL_OPTIONS)
def fill_tiles(
    first: int, stop: int, reach: NDArray[np.int16], across: int, places: Array64i, lists: Array32i
) -> None:
    """Write the places ``first..stop`` of projected Gaussians into the lists of their tiles.

    Args:
        first: First place.
        stop: One past the last place.
        reach: ``[N, 4]`` from `project`.
        across: Tiles in a row.
        places: Next index in ``lists`` of each tile ``[tiles]``; used up.
        lists: Lists of all tiles, written.
    """
    for at in range(first, stop):
        for j in range(reach[at, 2], reach[at, 3] + 1):
            for i in range(reach[at, 0], reach[at, 1] + 1):
                tile = j * across + i
                lists[places[tile]] = at
                places[tile] += 1


@njit(**KERNEL_OPTIONS)
def colour_along(harmonics, x, y, z, colour):  # type: ignore[no-untyped-def]
    """Write the colour ``[3]`` of one Gaussian along a unit direction; ``harmonics`` is ``[K, 3]``."""
    f = np.float32
    count = harmonics.shape[0]
    for c in range(3):
        value = f(0.28209479177387814) * harmonics[0, c] + _HALF
        if count > 1:
            value += f(0.4886025119029199) * (z * harmonics[2, c] - y * harmonics[1, c] - x * harmonics[3, c])
        if count > 4:
            value += f(1.0925484305920792) * (
                x * y * harmonics[4, c] - y * z * harmonics[5, c] - x * z * harmonics[7, c]
            )
            value += f(0.31539156525252005) * (f(3.0) * z * z - _ONE) * harmonics[6, c]
            value += f(0.5462742152960396) * (x * x - y * y) * harmonics[8, c]
        if count > 9:
            value += f(0.5900435899266435) * y * (y * y - f(3.0) * x * x) * harmonics[9, c]
            value += f(2.890611442640554) * x * y * z * harmonics[10, c]
            value += (
                f(0.4570457994644658)
                * (_ONE - f(5.0) * z * z)
                * (y * harmonics[11, c] + x * harmonics[13, c])
            )
            value += f(0.3731763325901154) * z * (f(5.0) * z * z - f(3.0)) * harmonics[12, c]
            value += f(1.445305721320277) * z * (x * x - y * y) * harmonics[14, c]
            value += f(0.5900435899266435) * x * (f(3.0) * y * y - x * x) * harmonics[15, c]
        colour[c] = max(value, _ZERO)


@njit(**_EXACT)
def _composite(at, projected, source, means, harmonics, centre, left, top, wide, high, light, found, colour):  # type: ignore[no-untyped-def]
    """Draw one Gaussian into a tile; returns how many pixels it closed.

    ``light`` is the transmittance of each pixel of the tile ``[TILE * TILE]``; ``found [TILE * TILE, 4]`` red, green, blue, depth by weight.
    """
    row = projected[at]
    u, v, within, z = row[U], row[V], row[WITHIN], row[Z]
    # The contour's box again, now inside the tile.
    det = row[A] * row[C] - _f(0.25) * row[B2] * row[B2]
    reach_x, reach_y = np.sqrt(within * row[C] / det), np.sqrt(within * row[A] / det)
    reach_x, reach_y = reach_x * _f(1.001) + _SLACK_PX, reach_y * _f(1.001) + _SLACK_PX
    # For a needle, whose determinant is lost to rounding: the whole tile.
    if not (det > _f(1e-6) * row[A] * row[C]):
        reach_x, reach_y = _f(1e9), _f(1e9)
    i0 = np.int64(max(u - reach_x - _HALF - _f(left), _ZERO))
    i1 = min(np.int64(max(min(u + reach_x - _HALF - _f(left), _f(TILE)), _f(-1.0))) + 1, wide)
    j0 = np.int64(max(v - reach_y - _HALF - _f(top), _ZERO))
    j1 = min(np.int64(max(min(v + reach_y - _HALF - _f(top), _f(TILE)), _f(-1.0))) + 1, high)
    coloured = False
    closed = 0
    for j in range(j0, j1):
        dy = (_f(top + j) + _HALF) - v
        for i in range(i0, i1):
            through = light[j * TILE + i]
            if through < _LEAST:
                continue
            dx = (_f(left + i) + _HALF) - u
            q = (row[A] * dx * dx + row[C] * dy * dy) + row[B2] * dx * dy
            if not (q >= _ZERO and q <= within):
                continue
            if not coloured:
                n = source[at]
                x, y, w = means[n, 0] - centre[0], means[n, 1] - centre[1], means[n, 2] - centre[2]
                scale = _ONE / max(np.sqrt(x * x + y * y + w * w), _f(1e-12))
                colour_along(harmonics[n], x * scale, y * scale, w * scale, colour)
                coloured = True
            alpha = min(row[OPACITY] * np.exp(-_HALF * q), _MOST)
            weight = through * alpha
            pixel = found[j * TILE + i]
            for c in range(3):
                pixel[c] += weight * colour[c]
            pixel[3] += weight * z
            after = through - weight
            light[j * TILE + i] = after
            if after < _LEAST:
                closed += 1
    return closed


@njit(**_EXACT)
def draw_tiles(
    first: int, stop: int, starts: Array64i, lists: Array32i, projected: Array32, source: Array32i, means: Array32, harmonics: Array32,
    centre: Array32, behind: Array32, rgb: Array32, depth_m: Array32, alpha: Array32,
) -> None:  # fmt: skip
    """Draw the tiles ``first..stop`` of one image.

    Args:
        first: First tile.
        stop: One past the last.
        starts: First index of each tile's list ``[tiles + 1]``.
        lists: From `fill_tiles`.
        projected: From `project`, as is the next.
        source: ``[N]``.
        means: ``[N, 3]`` [m].
        harmonics: ``[N, K, 3]``.
        centre: Place of the camera ``[3]`` [m].
        behind: Colour ``[3]`` behind everything.
        rgb: ``[H, W, 3]``, written.
        depth_m: Mean depth by weight ``[H, W]`` [m], written; infinite for empty pixels.
        alpha: ``[H, W]``, written.
    """
    height, width = alpha.shape
    across = (width + TILE - 1) // TILE
    light, found, colour = (
        np.empty(TILE * TILE, np.float32),
        np.empty((TILE * TILE, 4), np.float32),
        np.empty(3, np.float32),
    )
    begins = np.empty(_BUCKETS + 1, np.int64)
    for tile in range(first, stop):
        top, left = TILE * (tile // across), TILE * (tile % across)
        wide, high = min(TILE, width - left), min(TILE, height - top)
        light[:] = _ONE
        found[:] = _ZERO
        count = starts[tile + 1] - starts[tile]
        still = wide * high
        if count > 0:
            keys = _in_buckets(lists, starts[tile], count, projected, begins)
            for bucket in range(_BUCKETS):
                if begins[bucket] == begins[bucket + 1]:
                    continue
                part = keys[begins[bucket] : begins[bucket + 1]]
                part.sort()
                for key in part:
                    at = np.int64(key & np.uint64(0xFFFFFFFF))
                    still -= _composite(
                        at,
                        projected,
                        source,
                        means,
                        harmonics,
                        centre,
                        left,
                        top,
                        wide,
                        high,
                        light,
                        found,
                        colour,
                    )
                    if still == 0:
                        break
                if still == 0:
                    break
        for j in range(high):
            for i in range(wide):
                n = j * TILE + i
                for c in range(3):
                    rgb[top + j, left + i, c] = min(found[n, c] + light[n] * behind[c], _ONE)
                opacity = _ONE - light[n]
                alpha[top + j, left + i] = opacity
                depth_m[top + j, left + i] = found[n, 3] / opacity if opacity > _f(1e-3) else _f(np.inf)


@njit(**_EXACT)
def _in_buckets(lists, start, count, projected, begins):  # type: ignore[no-untyped-def]
    """Keys of a tile's Gaussians, grouped by depth: the depth's bits, which sort as the positive numbers do, and the place.

    ``begins [_BUCKETS + 1]`` is written.
    """
    depths = np.empty(count, np.float32)
    for n in range(count):
        depths[n] = projected[lists[start + n], Z]
    bits = depths.view(np.uint32)
    least, most = np.int64(bits.min()), np.int64(bits.max())
    span = most - least
    shift = np.int64(0)
    while (span >> shift) >= _BUCKETS:
        shift += 1
    begins[:] = 0
    for n in range(count):
        begins[((np.int64(bits[n]) - least) >> shift) + 1] += 1
    for bucket in range(_BUCKETS):
        begins[bucket + 1] += begins[bucket]
    keys = np.empty(count, np.uint64)
    for n in range(count):
        bucket = (np.int64(bits[n]) - least) >> shift
        keys[begins[bucket]] = (np.uint64(bits[n]) << np.uint64(32)) | np.uint64(lists[start + n])
        begins[bucket] += 1
    for bucket in range(_BUCKETS, 0, -1):
        begins[bucket] = begins[bucket - 1]
    begins[0] = 0
    return keys
