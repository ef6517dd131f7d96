"""CPU kernels of the multiresolution hash encoding: gather with trilinear weights, and its transpose.

A level is described by four numbers, kept in ``levels`` as int64 ``[L, 4]``: first row in the table, cells per axis, index mask
(entries - 1), and 1 if the level is indexed densely, 0 if hashed. Encodings are tiled and feature-major, ``[tiles, L * F, T]``: one
level writes contiguous rows, and the network after it reads contiguous rows.

A few points at a time first find their table rows and weights, in loops that the compiler turns into vector instructions, and then
read the table: reads that wait for memory then lie close together, and many wait at once.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.fields.row_blocks import POINTS, gather_block, scatter_block
from advnerf_core.parallel import KERNEL_OPTIONS

Array32 = NDArray[np.float32]
Array32u = NDArray[np.uint32]
Array64i = NDArray[np.int64]

PRIME_Y = 2654435761  # the spatial hash of Teschner et al. 2003, as used by Müller et al. 2022, equation 4
PRIME_Z = 805459861

CHUNK = 128  # points placed together
_NEXT = np.uint32(1)
# Products wrap at 32 bits; the mask of a level is shorter.
_PRIME_Y, _PRIME_Z = np.uint32(PRIME_Y), np.uint32(PRIME_Z)
_f = np.float32
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_gather_two, _gather_four = gather_block(2, 8, CHUNK), gather_block(4, 8, CHUNK)
_scatter_two, _scatter_four = scatter_block(2, 8, CHUNK), scatter_block(4, 8, CHUNK)


@njit(**KERNEL_OPTIONS)
def chunk_scratch() -> tuple[Array32u, Array32]:
    """Scratch of one thread for placing a chunk: table rows and cells ``[11 * CHUNK]``, weights and fractions ``[11 * CHUNK]``."""
    return np.empty(11 * CHUNK, np.uint32), np.empty(11 * CHUNK, np.float32)


@njit(**KERNEL_OPTIONS)
def _find_cells(points, begin, count, cells, index, fraction):  # type: ignore[no-untyped-def]
    """Cell of each point along x, y and z, and the fraction inside it; coordinates outside of [0, 1] are clamped."""
    last, side = np.int32(cells) - np.int32(1), _f(cells)
    for n in range(count):
        x = min(max(points[begin + n, 0], _ZERO), _ONE) * side
        y = min(max(points[begin + n, 1], _ZERO), _ONE) * side
        z = min(max(points[begin + n, 2], _ZERO), _ONE) * side
        i, j, k = min(np.int32(x), last), min(np.int32(y), last), min(np.int32(z), last)
        index[n], index[CHUNK + n], index[2 * CHUNK + n] = np.uint32(i), np.uint32(j), np.uint32(k)
        fraction[n], fraction[CHUNK + n], fraction[2 * CHUNK + n] = x - _f(i), y - _f(j), z - _f(k)


@njit(**KERNEL_OPTIONS)
def _dense_rows(index, count, cells, first, rows):  # type: ignore[no-untyped-def]
    side = np.uint32(cells) + _NEXT
    for n in range(count):
        a = index[n] + side * (index[CHUNK + n] + side * index[2 * CHUNK + n]) + first
        b, c = a + side, a + side * side
        d = c + side
        rows[n], rows[CHUNK + n] = a, a + _NEXT
        rows[2 * CHUNK + n], rows[3 * CHUNK + n] = b, b + _NEXT
        rows[4 * CHUNK + n], rows[5 * CHUNK + n] = c, c + _NEXT
        rows[6 * CHUNK + n], rows[7 * CHUNK + n] = d, d + _NEXT


@njit(**KERNEL_OPTIONS)
def _hashed_rows(index, count, mask, first, rows):  # type: ignore[no-untyped-def]
    for n in range(count):
        x0, y0, z0 = index[n], index[CHUNK + n] * _PRIME_Y, index[2 * CHUNK + n] * _PRIME_Z
        x1, y1, z1 = x0 + _NEXT, y0 + _PRIME_Y, z0 + _PRIME_Z
        a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
        rows[n], rows[CHUNK + n] = first + ((x0 ^ a) & mask), first + ((x1 ^ a) & mask)
        rows[2 * CHUNK + n], rows[3 * CHUNK + n] = first + ((x0 ^ b) & mask), first + ((x1 ^ b) & mask)
        rows[4 * CHUNK + n], rows[5 * CHUNK + n] = first + ((x0 ^ c) & mask), first + ((x1 ^ c) & mask)
        rows[6 * CHUNK + n], rows[7 * CHUNK + n] = first + ((x0 ^ d) & mask), first + ((x1 ^ d) & mask)


@njit(**KERNEL_OPTIONS)
def _trilinear(fraction, count, weights):  # type: ignore[no-untyped-def]
    for n in range(count):
        fx, fy, fz = fraction[n], fraction[CHUNK + n], fraction[2 * CHUNK + n]
        gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
        a, b, c, d = gy * gz, fy * gz, gy * fz, fy * fz
        weights[n], weights[CHUNK + n] = gx * a, fx * a
        weights[2 * CHUNK + n], weights[3 * CHUNK + n] = gx * b, fx * b
        weights[4 * CHUNK + n], weights[5 * CHUNK + n] = gx * c, fx * c
        weights[6 * CHUNK + n], weights[7 * CHUNK + n] = gx * d, fx * d


@njit(**KERNEL_OPTIONS)
def _place(points, begin, count, level, rows, weights):  # type: ignore[no-untyped-def]
    """Table rows and trilinear weights of the eight vertices around each of ``count`` points, x fastest; vertex ``k`` from ``k * CHUNK`` on."""
    index, fraction = rows[8 * CHUNK :], weights[8 * CHUNK :]
    first, cells = np.uint32(level[0]), level[1]
    _find_cells(points, begin, count, cells, index, fraction)
    if level[3] == 1:
        _dense_rows(index, count, cells, first, rows)
    else:
        _hashed_rows(index, count, np.uint32(level[2]), first, rows)
    _trilinear(fraction, count, weights)


# Rows are unsigned: numba wraps signed indices (a[-1]), and that check costs a third of the time here.


@njit(**KERNEL_OPTIONS)
def _gather(table, rows, weights, n, part, out, at, width):  # type: ignore[no-untyped-def]
    """Features of points ``n..n + part`` of a chunk, to element ``at`` of ``out`` and those beside it."""
    features, whole, flat = table.shape[1], part - part % POINTS, out.reshape(-1)
    for i in range(0, whole, POINTS):
        if features == 2:
            _gather_two(table, 2, 0, rows, weights, n + i, out, at + i, width)
        else:
            for j in range(0, features, 4):
                _gather_four(table, features, j, rows, weights, n + i, out, at + i + j * width, width)
    for i in range(whole, part):
        for j in range(features):
            total = _ZERO
            for k in range(8):
                total += table[np.uint64(rows[k * CHUNK + n + i]), j] * weights[k * CHUNK + n + i]
            flat[at + i + j * width] = total


@njit(**KERNEL_OPTIONS)
def _scatter(table, rows, weights, n, part, grad, at, width):  # type: ignore[no-untyped-def]
    """The transpose of ``_gather``, added to ``table``."""
    features, whole, flat = table.shape[1], part - part % POINTS, grad.reshape(-1)
    for i in range(0, whole, POINTS):
        if features == 2:
            _scatter_two(table, 2, 0, rows, weights, n + i, grad, at + i, width)
        else:
            for j in range(0, features, 4):
                _scatter_four(table, features, j, rows, weights, n + i, grad, at + i + j * width, width)
    for i in range(whole, part):
        for j in range(features):
            slope = flat[at + i + j * width]
            for k in range(8):
                table[np.uint64(rows[k * CHUNK + n + i]), j] += slope * weights[k * CHUNK + n + i]


@njit(**KERNEL_OPTIONS)
def encode_level(
    points: Array32, count: int, table: Array32, level: int, levels: Array64i, rows: Array32u, weights: Array32, out: Array32
) -> None:  # fmt: skip
    """Encode the first ``count`` points at one level; levels may run in parallel.

    Args:
        points: ``[>= count, 3]`` in [0, 1]; coordinates outside are clamped.
        count: Number of points.
        table: ``[entries, F]``, F even.
        levels: ``[L, 4]``.
        rows: Scratch from `chunk_scratch`, used by one thread at a time.
        out: Tiles ``[tiles, L * F, T]``; only the rows of this level are written.
    """
    features, tile = table.shape[1], out.shape[2]
    own = level * features
    for begin in range(0, count, CHUNK):
        here, n = min(CHUNK, count - begin), 0
        _place(points, begin, here, levels[level], rows, weights)
        while n < here:  # tiles, or the part of one
            block, column = (begin + n) // tile, (begin + n) % tile
            part = min(tile - column, here - n)
            at = (block * out.shape[1] + own) * tile + column
            _gather(table, rows, weights, n, part, out, at, tile)
            n += part


@njit(**KERNEL_OPTIONS)
def scatter_level(
    points: Array32, count: int, grad_out: Array32, level: int, levels: Array64i, rows: Array32u, weights: Array32, grad_table: Array32
) -> None:  # fmt: skip
    """Add the transpose of ``encode_level`` to ``grad_table``; levels may run in parallel.

    Args:
        points: ``[>= count, 3]`` in [0, 1].
        count: Number of points.
        grad_out: Tiles ``[tiles, L * F, T]``.
        levels: ``[L, 4]``.
        rows: Scratch from `chunk_scratch`, used by one thread at a time.
        grad_table: ``[entries, F]``, accumulated into.
    """
    features, tile = grad_table.shape[1], grad_out.shape[2]
    own = level * features
    for begin in range(0, count, CHUNK):
        here, n = min(CHUNK, count - begin), 0
        _place(points, begin, here, levels[level], rows, weights)
        while n < here:  # tiles, or the part of one
            block, column = (begin + n) // tile, (begin + n) % tile
            part = min(tile - column, here - n)
            at = (block * grad_out.shape[1] + own) * tile + column
            _scatter(grad_table, rows, weights, n, part, grad_out, at, tile)
            n += part


@njit(**KERNEL_OPTIONS)
def rows_to_tiles(values: Array32, first: int, stop: int, tiles: Array32) -> None:
    """Write values ``[N, K]`` of points to tiles ``first..stop`` of ``[tiles, K, T]``."""
    width, tile = tiles.shape[1], tiles.shape[2]
    for block in range(first, stop):
        for n in range(min(tile, values.shape[0] - block * tile)):
            for k in range(width):
                tiles[block, k, n] = values[block * tile + n, k]
