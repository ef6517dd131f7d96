"""CPU kernels of the multiresolution hash encoding: gather with trilinear weights, and its transpose.

A level is described by four numbers, kept in ``levels`` as int64 ``[L, 4]``: first row in the table, cells per axis, index mask
(entries - 1), and 1 if the level is indexed densely, 0 if hashed. Encodings are tiled and feature-major, ``[tiles, L * F, T]``: one
level writes contiguous rows, and the network after it reads contiguous rows.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.parallel import KERNEL_OPTIONS

Array32 = NDArray[np.float32]
Array64i = NDArray[np.int64]

PRIME_Y = 2654435761  # the spatial hash of Teschner et al. 2003, as used by Müller et al. 2022, equation 4
PRIME_Z = 805459861

# Rows are unsigned: numba wraps signed indices (a[-1]), and that check costs a third of the time here.
_U = np.uint64
_ONE = np.uint64(1)
_PRIME_Y = np.uint64(PRIME_Y)
_PRIME_Z = np.uint64(PRIME_Z)


@njit(**KERNEL_OPTIONS)
def _axis(x, cells):  # type: ignore[no-untyped-def]
    """Cell index and fraction inside it of one coordinate in [0, 1]; outside it is clamped."""
    position = min(max(x, np.float32(0.0)), np.float32(1.0)) * np.float32(cells)
    index = min(np.int32(position), np.int32(cells) - np.int32(1))
    return _U(index), position - np.float32(index)


@njit(**KERNEL_OPTIONS)
def _corners(ix, iy, iz, cells, mask, dense, first):  # type: ignore[no-untyped-def]
    """Table rows of the eight vertices of a cell, x fastest."""
    if dense:
        side = cells + _ONE
        a = ix + side * (iy + side * iz) + first
        b, c = a + side, a + side * side
        d = c + side
        return a, a + _ONE, b, b + _ONE, c, c + _ONE, d, d + _ONE
    x1 = ix + _ONE
    y0, z0 = iy * _PRIME_Y, iz * _PRIME_Z
    y1, z1 = y0 + _PRIME_Y, z0 + _PRIME_Z
    a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
    return (
        first + ((ix ^ a) & mask), first + ((x1 ^ a) & mask), first + ((ix ^ b) & mask), first + ((x1 ^ b) & mask),
        first + ((ix ^ c) & mask), first + ((x1 ^ c) & mask), first + ((ix ^ d) & mask), first + ((x1 ^ d) & mask),
    )  # fmt: skip


@njit(**KERNEL_OPTIONS)
def _weights(fx, fy, fz):  # type: ignore[no-untyped-def]
    """Trilinear weights of the eight vertices, in the order of ``_corners``."""
    one = np.float32(1.0)
    gx, gy, gz = one - fx, one - fy, one - fz
    a, b, c, d = gy * gz, fy * gz, gy * fz, fy * fz
    return gx * a, fx * a, gx * b, fx * b, gx * c, fx * c, gx * d, fx * d


@njit(**KERNEL_OPTIONS)
def encode_level(
    points: Array32, count: int, table: Array32, level: int, levels: Array64i, out: Array32
) -> None:
    """Encode the first ``count`` points at one level; levels may run in parallel.

    Args:
        points: ``[>= count, 3]`` in [0, 1]; outside, coordinates are clamped.
        count: Number of points.
        table: ``[entries, F]``, F even.
        level: Which level.
        levels: ``[L, 4]``.
        out: Tiles ``[tiles, L * F, T]``; only the rows of this level are written.
    """
    first, cells, mask = _U(levels[level, 0]), _U(levels[level, 1]), _U(levels[level, 2])
    dense = levels[level, 3] == 1
    features, tile = table.shape[1], out.shape[2]
    row = level * features
    for block in range((count + tile - 1) // tile):
        start = block * tile
        for n in range(min(tile, count - start)):
            ix, fx = _axis(points[start + n, 0], cells)
            iy, fy = _axis(points[start + n, 1], cells)
            iz, fz = _axis(points[start + n, 2], cells)
            a, b, c, d, e, f, g, h = _corners(ix, iy, iz, cells, mask, dense, first)
            p0, p1, p2, p3, p4, p5, p6, p7 = _weights(fx, fy, fz)
            for k in range(0, features, 2):  # pairs: the compiler then moves both with one instruction
                u = table[a, k] * p0 + table[b, k] * p1 + table[c, k] * p2 + table[d, k] * p3
                v = table[a, k + 1] * p0 + table[b, k + 1] * p1 + table[c, k + 1] * p2 + table[d, k + 1] * p3
                u += table[e, k] * p4 + table[f, k] * p5 + table[g, k] * p6 + table[h, k] * p7
                v += table[e, k + 1] * p4 + table[f, k + 1] * p5 + table[g, k + 1] * p6 + table[h, k + 1] * p7
                out[block, row + k, n] = u
                out[block, row + k + 1, n] = v


@njit(**KERNEL_OPTIONS)
def scatter_level(
    points: Array32, count: int, grad_out: Array32, level: int, levels: Array64i, grad_table: Array32
) -> None:
    """Add the transpose of ``encode_level`` to ``grad_table``; levels may run in parallel.

    Args:
        points: ``[>= count, 3]`` in [0, 1].
        count: Number of points.
        grad_out: Tiles ``[tiles, L * F, T]``.
        level: Which level.
        levels: ``[L, 4]``.
        grad_table: ``[entries, F]``, accumulated into.
    """
    first, cells, mask = _U(levels[level, 0]), _U(levels[level, 1]), _U(levels[level, 2])
    dense = levels[level, 3] == 1
    features, tile = grad_table.shape[1], grad_out.shape[2]
    row = level * features
    for block in range((count + tile - 1) // tile):
        start = block * tile
        for n in range(min(tile, count - start)):
            ix, fx = _axis(points[start + n, 0], cells)
            iy, fy = _axis(points[start + n, 1], cells)
            iz, fz = _axis(points[start + n, 2], cells)
            a, b, c, d, e, f, g, h = _corners(ix, iy, iz, cells, mask, dense, first)
            p0, p1, p2, p3, p4, p5, p6, p7 = _weights(fx, fy, fz)
            for k in range(0, features, 2):
                u, v = grad_out[block, row + k, n], grad_out[block, row + k + 1, n]
                grad_table[a, k] += u * p0
                grad_table[a, k + 1] += v * p0
                grad_table[b, k] += u * p1
                grad_table[b, k + 1] += v * p1
                grad_table[c, k] += u * p2
                grad_table[c, k + 1] += v * p2
                grad_table[d, k] += u * p3
                grad_table[d, k + 1] += v * p3
                grad_table[e, k] += u * p4
                grad_table[e, k + 1] += v * p4
                grad_table[f, k] += u * p5
                grad_table[f, k + 1] += v * p5
                grad_table[g, k] += u * p6
                grad_table[g, k + 1] += v * p6
                grad_table[h, k] += u * p7
                grad_table[h, k + 1] += v * p7
