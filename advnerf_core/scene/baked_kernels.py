"""The CPU kernels of a baked scene: values of the field at voxel corners, and rays that interpolate between corners.

A value is four bytes: the logarithm of density, and the colour. Space is a grid of cells; every cell has its eight corners in one coarse
grid, and cells seen from near by have a brick of more corners instead.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.fields.hash_grid_kernels import chunk_scratch, encode_level
from advnerf_core.fields.mlp_kernels import TILE, dense
from advnerf_core.parallel import KERNEL_OPTIONS
from advnerf_core.render.contraction import growing_step, into_cube, leap_contracted, span_before_far
from advnerf_core.render.march_kernels import span_in_box, step_size
from advnerf_core.render.occupancy import FLAT, FLATNESS
from advnerf_core.render.rays import write_ray
from advnerf_core.render.volume_kernels import MAX_LOG_DENSITY, squash_features

Array32 = NDArray[np.float32]
Array8 = NDArray[np.uint8]
Array64i = NDArray[np.int64]

# Logarithms of density per box side in a byte; anything thinner is invisible.
LOWEST_LOG = -4.0
LOG_STEP = (MAX_LOG_DENSITY - LOWEST_LOG) / 255.0
# Pixels of a tile, samples of a wave, and samples of one ray among them.
WIDE, HIGH, WAVE, AHEAD = 16, 16, 512, 2
INTO_CELL = np.float32(1e-4)  # m beyond an edge, so that rounding cannot trap a ray on it
TINY = np.float32(1e-9)  # cells a metre, for a ray along the other axes
_SEEN = np.float32(0.2)  # share of a pixel's light for a cell to count as seen
_f, _i = np.float32, np.int32  # in 64 bits, the words would fill twice as many vectors
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)
BYTE = np.float32(1.0 / 255.0)
LOWEST, STEP = np.float32(LOWEST_LOG), np.float32(LOG_STEP)
_IN_ORDER = {**KERNEL_OPTIONS, "fastmath": KERNEL_OPTIONS["fastmath"] - {"reassoc"}}


@njit(**KERNEL_OPTIONS)
def bake_points(
    points: Array32, first: int, stop: int, table: Array32, levels: Array64i, w1: Array32, b1: Array32, w2: Array32, b2: Array32,
    c1: Array32, d1: Array32, c2: Array32, d2: Array32, matrix: Array32, offset: Array32, power: np.float32, values: Array8,
) -> None:  # fmt: skip
    """Values of the field at points ``first..stop``.

    Args:
        points: ``[N, 3]`` points of the field.
        first: First point.
        stop: One past the last point.
        table: Hash table as in ``render_tiles``, as are the following.
        levels: ``[L, 4]``.
        w1: ``[H, L * F]``.
        b1: ``[H]``.
        w2: ``[1 + C, H]``.
        b2: ``[1 + C]``.
        c1: ``[H, K]``; inputs beyond the features are constant, as colours do not depend on the direction.
        d1: ``[H]``.
        c2: ``[4, H]``.
        d2: ``[4]``.
        matrix: Matrix of the colour map ``[3, 3]``.
        offset: Offset of the colour map ``[3]``.
        values: ``[N, 4]``, written.
    """
    channels = w2.shape[0] - 1
    encoded = np.zeros((1, w1.shape[1], TILE), np.float32)
    rows, weights = chunk_scratch()
    hidden, field = np.empty((w1.shape[0], TILE), np.float32), np.empty((w2.shape[0], TILE), np.float32)
    inputs = np.zeros((c1.shape[1], TILE), np.float32)
    decoded, colours = np.empty((c1.shape[0], TILE), np.float32), np.empty((4, TILE), np.float32)
    straight = np.empty(3, np.float32)
    for begin in range(first, stop, TILE):
        count = min(TILE, stop - begin)
        for level in range(levels.shape[0]):
            encode_level(points[begin:stop], count, table, level, levels, rows, weights, encoded)
        dense(w1, b1, encoded[0], hidden, True)
        dense(w2, b2, hidden, field, False)
        squash_features(field)
        for n in range(count):
            for c in range(channels):
                inputs[c, n] = field[1 + c, n]
            inputs[channels, n] = _f(0.28209479177387814)  # the constant spherical harmonic
        dense(c1, d1, inputs, decoded, True)
        dense(c2, d2, decoded, colours, False)
        for n in range(count):
            level_of = (field[0, n] - LOWEST) / STEP
            values[begin + n, 0] = np.uint8(min(max(level_of, _ZERO), _f(255.0)) + _f(0.5))
            for c in range(3):
                straight[c] = (_ONE / (_ONE + np.exp(-colours[c, n]))) ** power
            for c in range(3):
                mapped = offset[c]
                for k in range(3):
                    mapped += matrix[c, k] * straight[k]
                values[begin + n, 1 + c] = np.uint8(min(max(mapped, _ZERO), _ONE) * _f(255.0) + _f(0.5))


# Loops that call a function are not vectorised, unless numba itself inlines the function.
@njit(**_IN_ORDER, inline="always")
def between(p000, p001, p010, p011, p100, p101, p110, p111, fx, fy, fz):  # type: ignore[no-untyped-def]
    """The four parts of the value between corners, each a word of four bytes, at fractions along x, y and z."""
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    a, b, c, d = gx * gy * gz, gx * gy * fz, gx * fy * gz, gx * fy * fz
    e, f, g, h = fx * gy * gz, fx * gy * fz, fx * fy * gz, fx * fy * fz
    v0 = (_f(_i(p001 & 255)) * b + _f(_i(p000 & 255)) * a + _f(_i(p010 & 255)) * c + _f(_i(p011 & 255)) * d
          + _f(_i(p100 & 255)) * e + _f(_i(p101 & 255)) * f + _f(_i(p110 & 255)) * g + _f(_i(p111 & 255)) * h)  # fmt: skip
    v1 = (_f(_i(p001 >> 8 & 255)) * b + _f(_i(p000 >> 8 & 255)) * a + _f(_i(p010 >> 8 & 255)) * c + _f(_i(p011 >> 8 & 255)) * d
          + _f(_i(p100 >> 8 & 255)) * e + _f(_i(p101 >> 8 & 255)) * f + _f(_i(p110 >> 8 & 255)) * g + _f(_i(p111 >> 8 & 255)) * h)  # fmt: skip
    v2 = (_f(_i(p001 >> 16 & 255)) * b + _f(_i(p000 >> 16 & 255)) * a + _f(_i(p010 >> 16 & 255)) * c + _f(_i(p011 >> 16 & 255)) * d
          + _f(_i(p100 >> 16 & 255)) * e + _f(_i(p101 >> 16 & 255)) * f + _f(_i(p110 >> 16 & 255)) * g + _f(_i(p111 >> 16 & 255)) * h)  # fmt: skip
    v3 = (_f(_i(p001 >> 24 & 255)) * b + _f(_i(p000 >> 24 & 255)) * a + _f(_i(p010 >> 24 & 255)) * c + _f(_i(p011 >> 24 & 255)) * d
          + _f(_i(p100 >> 24 & 255)) * e + _f(_i(p101 >> 24 & 255)) * f + _f(_i(p110 >> 24 & 255)) * g + _f(_i(p111 >> 24 & 255)) * h)  # fmt: skip
    return v0, v1, v2, v3


@njit(**KERNEL_OPTIONS)
def _gather(words, base, strides, used, corners):  # type: ignore[no-untyped-def]
    """Read the corners of samples ``[:used]`` into ``corners [8, WAVE]``: many reads wait for memory at once."""
    for m in range(used):
        # Unsigned, because numba checks each signed index for counting from the end.
        at, line, plane = np.uint64(base[m]), np.uint64(strides[1, m]), np.uint64(strides[0, m])
        one = np.uint64(1)
        corners[0, m], corners[1, m] = words[at], words[at + one]
        corners[2, m], corners[3, m] = words[at + line], words[at + line + one]
        corners[4, m], corners[5, m] = words[at + plane], words[at + plane + one]
        corners[6, m], corners[7, m] = words[at + plane + line], words[at + plane + line + one]


@njit(**_IN_ORDER)
def _interpolate(corners, places, used, mixed):  # type: ignore[no-untyped-def]
    """`between` for samples ``[:used]``, in vector instructions, to ``mixed [4, WAVE]``."""
    for m in range(used):
        mixed[0, m], mixed[1, m], mixed[2, m], mixed[3, m] = between(
            corners[0, m], corners[1, m], corners[2, m], corners[3, m],
            corners[4, m], corners[5, m], corners[6, m], corners[7, m],
            places[0, m], places[1, m], places[2, m],
        )  # fmt: skip


@njit(**KERNEL_OPTIONS)
def _leap_all(grids, t, end, boxes, rays, count):  # type: ignore[no-untyped-def]
    """Take the rays ``rays[:count]``, in cells ``grids [N, 9]``, to the first occupied place at or after ``t``, or to their end.

    All rays advance in turn by one leap each: a leap waits for the ray's last one, but not for those of other rays. ``rays`` is used up.
    """
    nx, ny, nz = boxes.shape
    while count > 0:
        going = 0
        for a in range(count):
            n = rays[a]
            grid, s = grids[n], t[n]
            x, y, z = grid[0] + s * grid[3], grid[1] + s * grid[4], grid[2] + s * grid[5]
            i = min(max(np.int64(x), 0), nx - 1)
            j = min(max(np.int64(y), 0), ny - 1)
            k = min(max(np.int64(z), 0), nz - 1)
            box = np.int64(boxes[np.uint64(i), np.uint64(j), np.uint64(k)])
            reach = box & (FLAT - 1)
            across = reach * FLATNESS if box >= FLAT else reach
            u = (_f(i + across if grid[3] > _ZERO else i - across + 1) - x) * grid[6]
            v = (_f(j + across if grid[4] > _ZERO else j - across + 1) - y) * grid[7]
            w = (_f(k + reach if grid[5] > _ZERO else k - reach + 1) - z) * grid[8]
            further = s + max(min(min(u, v), w), _ZERO) + INTO_CELL
            goes = reach > 0 and s < end[n]
            t[n] = further if goes else s
            rays[going] = n
            going += 1 if goes else 0
        count = going


@njit(**KERNEL_OPTIONS)
def _leap_all_contracted(rays, t, end, distance, cells, active, count):  # type: ignore[no-untyped-def]
    """`_leap_all` in the contracted cube, for the rays ``active[:count]`` of ``rays [N, 6]``; ``active`` is used up."""
    while count > 0:
        going = 0
        for a in range(count):
            n = active[a]
            s = t[n]
            further = leap_contracted(rays[n], s, distance, cells) if s < end[n] else s
            t[n] = further
            active[going] = n
            going += 1 if further > s else 0
        count = going


@njit(**KERNEL_OPTIONS)
def render_baked(
    poses: Array32, intrinsics: Array32, first: int, stop: int, high: Array32, near: np.float32, steps: Array32, boxes: Array8,
    cells: Array32, brick_of: NDArray[np.int32], log_sides: Array8, words: NDArray[np.int32], behind: Array32, least_through: np.float32,
    max_samples: int, rgb: Array32, depth_m: Array32, alpha: Array32, nearest_m: Array32, contracted: bool,
) -> None:  # fmt: skip
    """Render pixel tiles ``first..stop`` of a batch of images.

    Rays of a tile advance together, and values for the next wave are prefetched: a sample waits for memory, not for arithmetic, and many
    can wait at once.

    Args:
        poses: ``[B, 3, 4]`` from ``poses_in_box``.
        intrinsics: ``fx, fy, cx, cy`` ``[4]``.
        first: First tile; tiles count row by row through each image, then through the batch.
        stop: One past the last tile.
        high: High corner of the box ``[3]``.
        near: Nearest ray parameter [m].
        steps: Smallest and largest interval [m] and growth per metre ``[3]``.
        boxes: Empty boxes ``[X, Y, Z]``, from ``flat_boxes``; leap distances if contracted.
        cells: Cells per unit ``[3]``.
        brick_of: First value of the brick of each cell ``[X * Y * Z]``; negative without a brick, for which the corners of cells are used,
            which come first among the values.
        log_sides: Logarithm to base 2 of the parts along each side of the bricks ``[X * Y * Z]``.
        words: The values ``[V]``, four bytes each.
        behind: Colour ``[3]`` behind everything.
        least_through: Transmittance at which a ray stops.
        max_samples: Most samples on one ray.
        rgb: ``[B, H, W, 3]``, written.
        depth_m: Planar depth ``[B, H, W]`` [m], written; infinite for empty pixels.
        alpha: ``[B, H, W]``, written.
        nearest_m: Per cell ``[X, Y, Z]``, the smallest distance from which it was seen, updated; empty to skip this.
        contracted: Whether the field is contracted.
    """
    nx, ny, nz = boxes.shape
    height, width = alpha.shape[1], alpha.shape[2]
    across_image, down = (width + WIDE - 1) // WIDE, (height + HIGH - 1) // HIGH
    row_stride, plane_stride = nz + 1, (ny + 1) * (nz + 1)
    marked = nearest_m.shape[0] > 0
    rays, grids, units = (
        np.empty((WIDE * HIGH, 6), np.float32),
        np.empty((WIDE * HIGH, 9), np.float32),
        np.empty(WIDE * HIGH, np.float32),
    )
    active, going = np.empty(WIDE * HIGH, np.int64), np.empty(WIDE * HIGH, np.int64)
    t, end, scale = (
        np.empty(WIDE * HIGH, np.float32),
        np.empty(WIDE * HIGH, np.float32),
        np.empty(WIDE * HIGH, np.float32),
    )
    through, taken = np.empty(WIDE * HIGH, np.float32), np.empty(WIDE * HIGH, np.int64)
    found = np.empty((WIDE * HIGH, 4), np.float32)  # reach and colour
    owner, cell = np.empty(WAVE, np.int64), np.empty(WAVE, np.int64)
    base, strides = np.empty(WAVE, np.int64), np.empty((2, WAVE), np.int64)
    places, corners, mixed = (
        np.empty((5, WAVE), np.float32),
        np.empty((8, WAVE), np.int32),
        np.empty((4, WAVE), np.float32),
    )
    for tile in range(first, stop):
        image, rest = tile // (across_image * down), tile % (across_image * down)
        top, left = HIGH * (rest // across_image), WIDE * (rest % across_image)
        count = np.int64(0)  # with literals, the called functions would be compiled twice
        for n in range(WIDE * HIGH):
            row, column = top + n // WIDE, left + n % WIDE
            if row >= height or column >= width:
                continue
            ray = rays[n]
            scale[n] = write_ray(poses[image], intrinsics, _f(column) + _f(0.5), _f(row) + _f(0.5), ray)
            t[n], end[n] = span_before_far(ray, near) if contracted else span_in_box(ray, high, near)
            units[n] = np.sqrt(ray[3] * ray[3] + ray[4] * ray[4] + ray[5] * ray[5])
            for axis in range(3):
                grids[n, axis], step = ray[axis] * cells[axis], ray[3 + axis] * cells[axis]
                step = step if abs(step) > TINY else TINY
                grids[n, 3 + axis], grids[n, 6 + axis] = step, _ONE / step
            through[n], taken[n] = _ONE, 0
            found[n, 0], found[n, 1], found[n, 2], found[n, 3] = _ZERO, _ZERO, _ZERO, _ZERO
            active[count] = n
            count += 1
        while count > 0:
            used, left_over = np.int64(0), np.int64(0)
            for _ in range(AHEAD if count * AHEAD <= WAVE else 1):
                for a in range(count):
                    going[a] = active[a]
                if contracted:
                    _leap_all_contracted(rays, t, end, boxes, cells, going, count)
                else:
                    _leap_all(grids, t, end, boxes, going, count)
                for a in range(count):
                    n = active[a]
                    if t[n] >= end[n] or taken[n] >= max_samples:
                        t[n] = end[n]
                        continue
                    grid, ray = grids[n], rays[n]
                    span = growing_step(ray, t[n], steps) if contracted else step_size(t[n], steps)
                    s = t[n] + _f(0.5) * span
                    x, y, z = grid[0] + s * grid[3], grid[1] + s * grid[4], grid[2] + s * grid[5]
                    if contracted:
                        x, y, z = into_cube(ray[0] + s * ray[3], ray[1] + s * ray[4], ray[2] + s * ray[5])
                        x, y, z = x * cells[0], y * cells[1], z * cells[2]
                    x = min(max(x, _ZERO), _f(nx) - _f(1e-3))
                    y = min(max(y, _ZERO), _f(ny) - _f(1e-3))
                    z = min(max(z, _ZERO), _f(nz) - _f(1e-3))
                    i, j, k = np.int64(x), np.int64(y), np.int64(z)
                    owner[used], cell[used] = n, (i * ny + j) * nz + k
                    base[used] = i * plane_stride + j * row_stride + k
                    strides[0, used], strides[1, used] = plane_stride, row_stride
                    places[0, used], places[1, used], places[2, used] = x - _f(i), y - _f(j), z - _f(k)
                    places[3, used], places[4, used] = span, s
                    t[n] += span
                    taken[n] += 1
                    used += 1
            for m in range(used):
                at = np.uint64(cell[m])
                brick = np.int64(brick_of[at])
                if brick >= 0:
                    side = np.int64(1) << np.int64(log_sides[at])
                    x, y, z = places[0, m] * _f(side), places[1, m] * _f(side), places[2, m] * _f(side)
                    i, j, k = (
                        min(np.int64(x), side - 1),
                        min(np.int64(y), side - 1),
                        min(np.int64(z), side - 1),
                    )
                    along = side + 1
                    strides[0, m], strides[1, m] = along * along, along
                    base[m] = brick + i * along * along + j * along + k
                    places[0, m], places[1, m], places[2, m] = x - _f(i), y - _f(j), z - _f(k)
            _gather(words, base, strides, used, corners)
            _interpolate(corners, places, used, mixed)
            for m in range(used):
                n = owner[m]
                if through[n] < least_through:
                    continue
                keep = np.exp(-np.exp(mixed[0, m] * STEP + LOWEST) * places[3, m] * units[n])
                weight = through[n] * (_ONE - keep)
                through[n] *= keep
                found[n, 0] += weight * places[4, m]
                found[n, 1] += weight * mixed[1, m]
                found[n, 2] += weight * mixed[2, m]
                found[n, 3] += weight * mixed[3, m]
                if marked and weight > _SEEN:
                    at = cell[m]
                    nearest_m.flat[at] = min(nearest_m.flat[at], places[4, m])
            for a in range(count):
                n = active[a]
                if through[n] >= least_through and t[n] < end[n]:
                    active[left_over] = n
                    left_over += 1
            count = left_over
        for n in range(WIDE * HIGH):
            row, column = top + n // WIDE, left + n % WIDE
            if row >= height or column >= width:
                continue
            for c in range(3):
                rgb[image, row, column, c] = found[n, 1 + c] * BYTE + through[n] * behind[c]
            opacity = _ONE - through[n]
            alpha[image, row, column] = opacity
            depth_m[image, row, column] = (
                scale[n] * found[n, 0] / opacity if opacity > _f(1e-3) else _f(np.inf)
            )
