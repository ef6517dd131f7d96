"""The CPU kernel that casts a voxel-grid object into a window of pixels.

Rays run in voxel coordinates: voxel ``i`` of an axis has its value at ``i``, the box reaches from ``-0.5`` to ``n - 0.5``. Samples lie
evenly between entry and exit of the ray. Those in empty cells are leapt over, several at a time: a table gives for
each cell the distance within which all cells are empty, so skipped samples are exactly those without contribution.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from advnerf_core.parallel import KERNEL_OPTIONS

NEAR_M = 0.02  # anything closer to the camera is not drawn
# A ray ends when less than a quarter of an 8-bit step of light remains; its last sample takes the rest.
LEAST_TRANSMITTANCE = 1e-3
# Progress of a cast: next pixel of the window, covered pixels, weights written.
NEXT, FOUND, FILLED = 0, 1, 2
# Of a ray, after where its first sample lies and how far the next is (in voxels): object units a metre, metres between samples, and
# the planar depth of the first.
SPEED, DT, BEGIN = 6, 7, 8
_PIXEL_ROUNDING = 1e-6
_MANY = 1e9  # samples; more than any ray has
_ROUNDING = 1e-9  # samples; a leap may not end beyond an occupied cell for the last bit of a float


@njit(**KERNEL_OPTIONS)
def span_in_box(o: Any, d: Any, sizes: Any, near: float) -> tuple[float, float, bool]:
    """Ray parameters of entry and exit, and whether the entry is through the ``+x`` face; exit <= entry is a miss."""
    t_in, t_out, by_face = near, np.inf, False
    for axis in range(3):
        low, high = -0.5, sizes[axis] - 0.5
        if abs(d[axis]) < 1e-15:
            if o[axis] < low or o[axis] > high:
                return 1.0, 0.0, False
            continue
        t_low, t_high = (low - o[axis]) / d[axis], (high - o[axis]) / d[axis]
        first, last = min(t_low, t_high), max(t_low, t_high)
        if first > t_in:
            t_in = first
            by_face = axis == 0 and d[0] < 0.0
        t_out = min(t_out, last)
    return t_in, t_out, by_face


@njit(**KERNEL_OPTIONS)
def cell_of(position: float, count: int) -> int:
    """First of the two voxels that ``position`` lies between; clamped at both ends."""
    return max(min(int(math.floor(position)), count - 2), 0)  # noqa: RUF046 - a float on a GPU


@njit(**KERNEL_OPTIONS)
def steps_to_leap(position: float, stride: float, cell: int, clear: int) -> int:
    """Number of samples from ``position`` on, itself included, that surely stay within ``clear`` cells of ``cell``."""
    if stride > 0.0:
        return int(min((cell + clear - position) / stride - _ROUNDING, 1e9)) + 1
    if stride < 0.0:
        return int(min((position - (cell - clear + 1)) / -stride - _ROUNDING, 1e9)) + 1
    return 1_000_000_000


@njit(**KERNEL_OPTIONS)
def share_of(position: float, first: int, count: int) -> float:
    """Weight of the second of the two voxels around ``position``."""
    return min(max(position, 0.0), count - 1.0) - first


@njit(**KERNEL_OPTIONS)
def box_windows(T: Any, box: Any, intrinsics: Any, width: int, height: int) -> Any:
    """Pixels ``[B, 4]`` (first row, end row, first column, end column) that surely contain a box.

    Args:
        T: Box to camera ``[B, 4, 4]``; one that is not finite sees nothing.
        box: Lowest and highest corner ``[2, 3]`` [m].
        intrinsics: ``fx, fy, cx, cy`` ``[4]``.
        width: Width of the image [pixels].
        height: Height of the image [pixels].
    """
    out, corners, seen = np.zeros((len(T), 4), np.int64), np.empty((8, 3)), np.empty(6)
    for b in range(len(T)):
        for k in range(8):
            x, y, z = box[k & 1, 0], box[k >> 1 & 1, 1], box[k >> 2, 2]
            for axis in range(3):
                corners[k, axis] = T[b, axis, 0] * x + T[b, axis, 1] * y + T[b, axis, 2] * z + T[b, axis, 3]
        if _seen_part(corners, seen):
            first, last = seen[2] * intrinsics[1] + intrinsics[3], seen[3] * intrinsics[1] + intrinsics[3]
            left, right = seen[0] * intrinsics[0] + intrinsics[2], seen[1] * intrinsics[0] + intrinsics[2]
            out[b, 0] = min(max(np.floor(first) - 1.0, 0.0), height)
            out[b, 1] = min(max(np.ceil(last) + 1.0, 0.0), height)
            out[b, 2] = min(max(np.floor(left) - 1.0, 0.0), width)
            out[b, 3] = min(max(np.ceil(right) + 1.0, 0.0), width)
    return out


@njit(**KERNEL_OPTIONS)
def _seen_part(corners: Any, seen: Any) -> bool:
    """Bounds of the part of a box that is further from the camera than `NEAR_M`; whether there is one.

    Args:
        corners: Its corners in the camera ``[8, 3]`` [m]; neighbours differ in one bit of their number.
        seen: Lowest and highest ``x / z``, lowest and highest ``y / z``, lowest and highest ``z`` ``[6]``; written.
    """
    seen[0] = seen[2] = seen[4] = np.inf
    seen[1] = seen[3] = seen[5] = -np.inf
    for k in range(8):
        depth = corners[k, 2]
        if not depth > NEAR_M:  # also for a pose that is not finite
            continue
        _include(corners[k, 0] / depth, corners[k, 1] / depth, depth, seen)
        for axis in range(3):
            other = k ^ (1 << axis)
            behind = corners[other, 2]
            if behind <= NEAR_M:  # the edge between them crosses the nearest plane
                share = (depth - NEAR_M) / (depth - behind)
                x = corners[k, 0] + share * (corners[other, 0] - corners[k, 0])
                y = corners[k, 1] + share * (corners[other, 1] - corners[k, 1])
                _include(x / NEAR_M, y / NEAR_M, NEAR_M, seen)
    return bool(seen[4] < np.inf)


@njit(**KERNEL_OPTIONS)
def _include(x: float, y: float, z: float, seen: Any) -> None:
    seen[0], seen[1] = min(seen[0], x), max(seen[1], x)
    seen[2], seen[3] = min(seen[2], y), max(seen[3], y)
    seen[4], seen[5] = min(seen[4], z), max(seen[5], z)


@njit(**KERNEL_OPTIONS)
def reach_of_bricks(
    C: Any, o: Any, bricks: Any, window: Any, intrinsics: Any, nearest_m: Any, furthest_m: Any
) -> None:
    """Planar depths between which the rays of each pixel may meet the object; where nearest > furthest, they do not.

    Args:
        C: Voxel coordinates to the camera ``[3, 3]``, the inverse of ``R`` in `cast_window`.
        o: Camera centre in voxel coordinates ``[3]``.
        bricks: Boxes in voxel coordinates that contain the object ``[N, 2, 3]``.
        window: First row, end row, first column, end column ``[4]``.
        intrinsics: ``fx, fy, cx, cy`` ``[4]``.
        nearest_m: ``[rows, columns]`` of the window, infinite; lowered.
        furthest_m: ``[rows, columns]`` of the window, minus infinite; raised.
    """
    corners, seen = np.empty((8, 3)), np.empty(6)
    for n in range(len(bricks)):
        for k in range(8):
            x, y, z = bricks[n, k & 1, 0] - o[0], bricks[n, k >> 1 & 1, 1] - o[1], bricks[n, k >> 2, 2] - o[2]
            for axis in range(3):
                corners[k, axis] = C[axis, 0] * x + C[axis, 1] * y + C[axis, 2] * z
        if not _seen_part(corners, seen):
            continue
        low_u, high_u = seen[0] * intrinsics[0] + intrinsics[2], seen[1] * intrinsics[0] + intrinsics[2]
        low_v, high_v = seen[2] * intrinsics[1] + intrinsics[3], seen[3] * intrinsics[1] + intrinsics[3]
        near, far = seen[4], seen[5]
        # Within the image first: a part next to the camera may reach further than an integer can say.
        first = max(window[0], int(np.floor(max(low_v - _PIXEL_ROUNDING, -1.0))))
        left = max(window[2], int(np.floor(max(low_u - _PIXEL_ROUNDING, -1.0))))
        last = min(window[1] - 1, int(np.floor(min(high_v + _PIXEL_ROUNDING, window[1] * 1.0))))
        right = min(window[3] - 1, int(np.floor(min(high_u + _PIXEL_ROUNDING, window[3] * 1.0))))
        for row in range(first, last + 1):
            for column in range(left, right + 1):
                at = row - window[0], column - window[2]
                nearest_m[at] = min(nearest_m[at], near)
                furthest_m[at] = max(furthest_m[at], far)


@njit(**KERNEL_OPTIONS)
def _set_out(R: Any, o: Any, edges: Any, sizes: Any, aims: Any, count: int, solid: bool, one_sided: bool, step: float,
             rays: Any, spans: Any) -> None:  # fmt: skip
    """Sample ranges of rays, in vector instructions: `span_in_box` without branches, and the samples between.

    Args:
        R: Rotation as in `cast_window`, as are the following.
        o: ``[3]``.
        edges: ``[3]``.
        sizes: Voxels along each axis.
        aims: ``x`` and ``y`` of each ray at unit depth, and its range of depths that may meet the object ``[4, N]``.
        solid: One sample where the ray enters.
        one_sided: Only rays through the ``+x`` face count.
        step: Object units between samples.
        rays: ``[9, N]``, written.
        spans: First relevant sample, and one past the last, ``[2, N]``; written.
    """
    # By name, so that the loop need not read them again after each write.
    xx, xy, xz = R[0, 0], R[0, 1], R[0, 2]
    yx, yy, yz = R[1, 0], R[1, 1], R[1, 2]
    zx, zy, zz = R[2, 0], R[2, 1], R[2, 2]
    ox, oy, oz, ex, ey, ez = o[0], o[1], o[2], edges[0], edges[1], edges[2]
    high_x, high_y, high_z = sizes[0] - 0.5, sizes[1] - 0.5, sizes[2] - 0.5
    beside_x, beside_y, beside_z = (
        ox < -0.5 or ox > high_x,
        oy < -0.5 or oy > high_y,
        oz < -0.5 or oz > high_z,
    )
    for n in range(count):
        x, y, nearest, furthest = aims[0, n], aims[1, n], aims[2, n], aims[3, n]
        dx, dy, dz = xx * x + xy * y + xz, yx * x + yy * y + yz, zx * x + zy * y + zz
        along_x, along_y, along_z = abs(dx) < 1e-15, abs(dy) < 1e-15, abs(dz) < 1e-15
        misses = (along_x & beside_x) | (along_y & beside_y) | (along_z & beside_z)
        ax, bx = (-0.5 - ox) / dx, (high_x - ox) / dx
        ay, by = (-0.5 - oy) / dy, (high_y - oy) / dy
        az, bz = (-0.5 - oz) / dz, (high_z - oz) / dz
        in_x = -np.inf if along_x else min(ax, bx)
        in_y = -np.inf if along_y else min(ay, by)
        in_z = -np.inf if along_z else min(az, bz)
        out_x = np.inf if along_x else max(ax, bx)
        out_y = np.inf if along_y else max(ay, by)
        out_z = np.inf if along_z else max(az, bz)
        by_face = (dx < 0.0) & (in_x > NEAR_M) & (in_x >= in_y) & (in_x >= in_z)
        t_in, t_out = max(max(max(NEAR_M, in_x), in_y), in_z), min(min(out_x, out_y), out_z)
        misses = misses | (t_out <= t_in) | (one_sided & (not by_face))
        # Object units a metre of planar depth.
        speed = np.sqrt((dx * ex) ** 2 + (dy * ey) ** 2 + (dz * ez) ** 2)
        samples = 1.0 if solid else max(1.0, np.ceil((t_out - t_in) * speed / step))
        dt = (t_out - t_in) / samples
        begin = t_in if solid else t_in + 0.5 * dt
        rays[0, n], rays[1, n], rays[2, n] = ox + begin * dx, oy + begin * dy, oz + begin * dz
        rays[3, n], rays[4, n], rays[5, n] = dt * dx, dt * dy, dt * dz
        rays[SPEED, n], rays[DT, n], rays[BEGIN, n] = speed, dt, begin
        # With a sample to spare at both ends.
        first = 0.0 if solid else min(max((nearest - begin) / dt - 1.0, 0.0), _MANY)
        last = samples if solid else min(samples, min(max((furthest - begin) / dt, 0.0), _MANY) + 2.0)
        spans[0, n], spans[1, n] = np.int32(first), np.int32(0.0 if misses else last)


@njit(**KERNEL_OPTIONS)
def _leap(rays: Any, n: int, i: int, clear: Any) -> int:
    """The next relevant sample of ray ``n`` at or after sample ``i``; ``i`` itself if its cell is not empty."""
    nx, ny, nz = clear.shape[0] + 1, clear.shape[1] + 1, clear.shape[2] + 1
    x, y, z = rays[0, n] + i * rays[3, n], rays[1, n] + i * rays[4, n], rays[2, n] + i * rays[5, n]
    cx, cy, cz = cell_of(x, nx), cell_of(y, ny), cell_of(z, nz)
    reach = int(clear[np.uint64(cx), np.uint64(cy), np.uint64(cz)])
    leap = min(
        steps_to_leap(x, rays[3, n], cx, reach),
        steps_to_leap(y, rays[4, n], cy, reach),
        steps_to_leap(z, rays[5, n], cz, reach),
    )
    return i + max(leap, 1) if reach > 0 else i


@njit(**KERNEL_OPTIONS)
def _leap_all(rays: Any, spans: Any, count: int, going: Any, clear: Any) -> None:
    """Take ``count`` rays to their first samples in cells that are not empty, or to their ends.

    All rays advance in turn by one leap each: a leap waits for the ray's last one, but not for those of other rays.
    """
    under_way = 0
    for n in range(count):
        going[under_way] = n
        under_way += 1 if spans[0, n] < spans[1, n] else 0
    while under_way > 0:
        left = 0
        for k in range(under_way):
            n = going[k]
            i = spans[0, n]
            j = _leap(rays, n, i, clear)
            spans[0, n], going[left] = j, n
            left += 1 if i < j < spans[1, n] else 0
        under_way = left


@njit(**KERNEL_OPTIONS)
def _march(rays: Any, n: int, spans: Any, slots: Any, density: Any, clear: Any, solid: bool, share: float, row: Any, touched: Any,
           count: int) -> tuple[int, float, float]:  # fmt: skip
    """Add ray ``n`` to the scratch ``row [slots]``; returns the touched count, the ray's alpha and alpha-weighted depth."""
    nx, ny, nz = slots.shape
    gx, gy, gz, sx, sy, sz = rays[0, n], rays[1, n], rays[2, n], rays[3, n], rays[4, n], rays[5, n]
    speed, dt, begin = rays[SPEED, n], rays[DT, n], rays[BEGIN, n]
    transmittance, alpha, alpha_depth = 1.0, 0.0, 0.0
    i, samples = np.int64(spans[0, n]), np.int64(spans[1, n])
    while i < samples:
        x, y, z = gx + i * sx, gy + i * sy, gz + i * sz
        cx, cy, cz = cell_of(x, nx), cell_of(y, ny), cell_of(z, nz)
        # Unsigned, because numba checks each signed index for counting from the end.
        lx, ly, lz = np.uint64(cx), np.uint64(cy), np.uint64(cz)
        if not solid and clear[lx, ly, lz] > 0:
            i = _leap(rays, n, i, clear)
            continue
        fx, fy, fz = share_of(x, cx, nx), share_of(y, cy, ny), share_of(z, cz, nz)
        hx, hy, hz = (
            np.uint64(min(cx + 1, nx - 1)),
            np.uint64(min(cy + 1, ny - 1)),
            np.uint64(min(cz + 1, nz - 1)),
        )
        opacity = 1.0
        if not solid:
            near = ((density[lx, ly, lz] * (1.0 - fz) + density[lx, ly, hz] * fz) * (1.0 - fy)
                    + (density[lx, hy, lz] * (1.0 - fz) + density[lx, hy, hz] * fz) * fy)  # fmt: skip
            far = ((density[hx, ly, lz] * (1.0 - fz) + density[hx, ly, hz] * fz) * (1.0 - fy)
                   + (density[hx, hy, lz] * (1.0 - fz) + density[hx, hy, hz] * fz) * fy)  # fmt: skip
            sigma = near * (1.0 - fx) + far * fx
            if sigma <= 0.0:  # outside a surface between voxels
                i += 1
                continue
            opacity = 1.0 - np.exp(-sigma * dt * speed)
            if transmittance * (1.0 - opacity) < LEAST_TRANSMITTANCE:
                opacity = 1.0
        weight = transmittance * opacity * share
        if weight > 0.0:
            alpha += weight
            alpha_depth += weight * (begin + i * dt)
            for k in range(8):
                part = (
                    (fx if k & 1 else 1.0 - fx)
                    * (fy if k & 2 else 1.0 - fy)
                    * (fz if k & 4 else 1.0 - fz)
                    * weight
                )
                if part > 0.0:
                    slot = np.uint64(slots[hx if k & 1 else lx, hy if k & 2 else ly, hz if k & 4 else lz])
                    # Written in any case: whether a slot is new is an unpredictable branch.
                    touched[np.uint64(count)] = slot
                    count += 1 if row[slot] == 0.0 else 0
                    row[slot] += part
        transmittance *= 1.0 - opacity
        if transmittance <= 0.0:
            break
        i += 1
    return count, alpha, alpha_depth


@njit(**KERNEL_OPTIONS)
def cast_window(R: Any, o: Any, edges: Any, window: Any, intrinsics: Any, nearest_m: Any, furthest_m: Any, width: int, supersample: int, slots: Any,
                density: Any, clear: Any, solid: bool, one_sided: bool, step: float, row: Any, touched: Any,
                progress: Any, pixels: Any, alphas: Any, depths: Any, ends: Any, indices: Any, values: Any) -> bool:  # fmt: skip
    """Cast the rays of one window, starting at ``progress``.

    Args:
        R: Directions of unit planar depth in the camera to voxel coordinates ``[3, 3]``.
        o: Camera centre in voxel coordinates ``[3]``.
        edges: Object units per voxel along each axis ``[3]``.
        window: First row, end row, first column, end column ``[4]``.
        intrinsics: ``fx, fy, cx, cy`` ``[4]``.
        nearest_m: From `reach_of_bricks`.
        width: Pixels in a row of the image.
        supersample: Rays along each side of a pixel.
        slots: ``[nx, ny, nz]`` int32.
        density: ``[nx, ny, nz]``; not read if ``solid``.
        clear: Cells around each cell between voxels that are empty, ``[nx - 1, ny - 1, nz - 1]``; not read if ``solid``.
        solid: One sample where the ray enters.
        one_sided: Only rays through the ``+x`` face count.
        step: Object units between samples.
        row: Scratch ``[slots]``, zero before and after.
        touched: Scratch ``[slots + 1]``.
        progress: ``[NEXT, FOUND, FILLED]``, updated.
        pixels: Flat indices ``[P]``, written.
        alphas: ``[P]``, written.
        depths: ``[P]``, written.
        ends: End of each pixel's weights ``[P]``, written.
        indices: Slots of the weights, written.

    Returns:
        Whether the window is finished; if not, ``indices`` and ``values`` were full: enlarge them and call again.
    """
    share, sizes, per_pixel = 1.0 / (supersample * supersample), slots.shape, supersample * supersample
    down, across = window[1] - window[0], window[3] - window[2]
    most = across * per_pixel
    aims, rays, spans = np.empty((4, most)), np.empty((9, most)), np.empty((2, most), np.int32)
    columns, going = np.empty(across, np.int64), np.empty(most, np.int64)
    while progress[NEXT] < down * across:
        line, alive = progress[NEXT] // across, 0
        for column in range(progress[NEXT] % across, across):
            if nearest_m[line, column] > furthest_m[line, column]:
                continue
            for r in range(per_pixel):
                n, u, v = alive * per_pixel + r, window[2] + column, window[0] + line
                aims[0, n] = (u + (r % supersample + 0.5) / supersample - intrinsics[2]) / intrinsics[0]
                aims[1, n] = (v + (r // supersample + 0.5) / supersample - intrinsics[3]) / intrinsics[1]
                aims[2, n], aims[3, n] = nearest_m[line, column], furthest_m[line, column]
            columns[alive] = column
            alive += 1
        _set_out(R, o, edges, sizes, aims, alive * per_pixel, solid, one_sided, step, rays, spans)
        if not solid:
            _leap_all(rays, spans, alive * per_pixel, going, clear)
        for pixel in range(alive):
            alpha, alpha_depth, count = (
                0.0,
                0.0,
                np.int64(0),
            )  # for a literal, `_march` would be compiled twice
            for n in range(pixel * per_pixel, (pixel + 1) * per_pixel):
                count, a, ad = _march(
                    rays, n, spans, slots, density, clear, solid, share, row, touched, count
                )
                alpha += a
                alpha_depth += ad
            filled, found = progress[FILLED], progress[FOUND]
            room = filled + count <= len(indices)
            for k in range(count):
                if room:
                    indices[filled + k] = touched[k]
                    values[filled + k] = row[touched[k]]
                row[touched[k]] = 0.0
            progress[NEXT] = line * across + columns[pixel]
            if not room:
                return False
            if alpha > 0.0:
                pixels[found] = (window[0] + line) * width + window[2] + columns[pixel]
                alphas[found] = min(alpha, 1.0)
                depths[found] = alpha_depth / alpha
                ends[found] = filled + count
                progress[FOUND], progress[FILLED] = found + 1, filled + count
        progress[NEXT] = (line + 1) * across
    return True
