"""The CPU kernel that renders a trained scene field: rays of a pixel tile advance together, so networks see full tiles of samples.

A wave takes one or more samples from every ray of the tile that has not ended, evaluates them together and composites
them; rays whose transmittance is used up drop out. Nothing leaves the cache in between. Same inputs, same bits.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.fields.hash_grid_kernels import chunk_scratch, encode_level
from advnerf_core.fields.mlp_kernels import TILE, dense
from advnerf_core.fields.spherical_harmonics import write_spherical_harmonics
from advnerf_core.parallel import KERNEL_OPTIONS
from advnerf_core.render.contraction import growing_step, into_cube, next_sample_contracted, span_before_far
from advnerf_core.render.march_kernels import next_sample, span_in_box, step_size
from advnerf_core.render.rays import write_ray
from advnerf_core.render.volume_kernels import MAX_LOG_DENSITY, squash_features

Array32 = NDArray[np.float32]
Array64i = NDArray[np.int64]

SIDE = 16  # pixels: 16 x 16 rays fill one tile
_f = np.float32
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)
_TOP = np.float32(MAX_LOG_DENSITY)


@njit(**KERNEL_OPTIONS)
def render_tiles(
    poses: Array32, intrinsics: Array32, first: int, stop: int, high: Array32, near: np.float32, steps: Array32,
    distance: NDArray[np.uint8], cells: Array32, table: Array32, levels: Array64i, w1: Array32, b1: Array32, w2: Array32,
    b2: Array32, c1: Array32, d1: Array32, c2: Array32, d2: Array32, background: Array32, bands: int,
    least_through: np.float32, max_samples: int, rgb: Array32, depth_m: Array32, alpha: Array32,
    contracted: bool,
) -> int:  # fmt: skip
    """Render pixel tiles ``first..stop`` of a batch of images.

    Args:
        poses: ``[B, 3, 4]`` from ``poses_in_box``.
        intrinsics: ``fx, fy, cx, cy`` ``[4]``.
        first: First tile; tiles count row by row through each image, then through the batch.
        stop: One past the last tile.
        high: High corner of the box ``[3]``.
        near: Nearest ray parameter [m].
        steps: Smallest and largest interval [m] and growth per metre ``[3]``.
        distance: Leap distances ``[X, Y, Z]``.
        cells: Cells per unit ``[3]``.
        table: Hash table ``[entries, F]``.
        levels: ``[L, 4]``.
        w1: Density network, first layer ``[H, L * F]``.
        b1: ``[H]``.
        w2: Density network, second layer ``[1 + C, H]``.
        b2: ``[1 + C]``.
        c1: Colour network, first layer ``[H, K]``.
        d1: ``[H]``.
        c2: Colour network, second layer ``[4, H]``.
        d2: ``[4]``.
        background: ``[C]``.
        bands: Bands of spherical harmonics.
        least_through: Transmittance at which a ray stops.
        max_samples: Most samples on one ray.
        rgb: ``[B, H, W, 3]``, written.
        depth_m: Planar depth ``[B, H, W]`` [m], written; infinite for empty pixels.
        alpha: ``[B, H, W]``, written.
        contracted: Whether the field is contracted.

    Returns:
        Number of samples evaluated.
    """
    height, width, channels = alpha.shape[1], alpha.shape[2], background.shape[0]
    across, down = (width + SIDE - 1) // SIDE, (height + SIDE - 1) // SIDE
    rays, active = np.empty((TILE, 6), np.float32), np.empty(TILE, np.int64)
    t, end, through = np.empty(TILE, np.float32), np.empty(TILE, np.float32), np.empty(TILE, np.float32)
    reach, scale = np.empty(TILE, np.float32), np.empty(TILE, np.float32)
    taken = np.empty(TILE, np.int64)
    points, owner = np.zeros((TILE, 3), np.float32), np.empty(TILE, np.int64)
    spans, middles = np.empty(TILE, np.float32), np.empty(TILE, np.float32)
    encoded = np.zeros((1, w1.shape[1], TILE), np.float32)
    rows, weights = chunk_scratch()
    hidden, field = np.empty((w1.shape[0], TILE), np.float32), np.empty((w2.shape[0], TILE), np.float32)
    inputs = np.zeros((c1.shape[1], TILE), np.float32)
    decoded, colours = np.empty((c1.shape[0], TILE), np.float32), np.empty((4, TILE), np.float32)
    total = 0
    for tile in range(first, stop):
        image, rest = tile // (across * down), tile % (across * down)
        top, left = SIDE * (rest // across), SIDE * (rest % across)
        count = 0
        for n in range(TILE):
            row, column = top + n // SIDE, left + n % SIDE
            if row >= height or column >= width:
                continue
            scale[n] = write_ray(poses[image], intrinsics, _f(column) + _f(0.5), _f(row) + _f(0.5), rays[n])
            t[n], end[n] = span_before_far(rays[n], near) if contracted else span_in_box(rays[n], high, near)
            through[n], reach[n], taken[n] = _ONE, _ZERO, 0
            active[count] = n
            count += 1
        inputs[:] = _ZERO
        while count > 0:
            each = TILE // count
            used, left_over = 0, 0
            for a in range(count):
                n = active[a]
                ray = rays[n]
                units = np.sqrt(ray[3] * ray[3] + ray[4] * ray[4] + ray[5] * ray[5])
                for _ in range(each):
                    if contracted:
                        t[n] = next_sample_contracted(ray, t[n], end[n], distance, cells)
                    else:
                        t[n] = next_sample(ray, t[n], end[n], distance, cells)
                    if t[n] >= end[n] or taken[n] >= max_samples:
                        t[n] = end[n]
                        break
                    span = growing_step(ray, t[n], steps) if contracted else step_size(t[n], steps)
                    s = t[n] + _f(0.5) * span
                    px, py, pz = ray[0] + s * ray[3], ray[1] + s * ray[4], ray[2] + s * ray[5]
                    if contracted:
                        px, py, pz = into_cube(px, py, pz)
                    points[used, 0], points[used, 1], points[used, 2] = px, py, pz
                    spans[used], middles[used], owner[used] = span * units, s, n
                    t[n] += span
                    taken[n] += 1
                    used += 1
            total += used
            if used > 0:
                for level in range(levels.shape[0]):
                    encode_level(points, used, table, level, levels, rows, weights, encoded)
                dense(w1, b1, encoded[0], hidden, True)
                dense(w2, b2, hidden, field, False)
                squash_features(field)
            for i in range(used):
                n = owner[i]
                if through[n] < least_through:
                    continue
                keep = np.exp(-np.exp(min(field[0, i], _TOP)) * spans[i])
                weight = through[n] * (_ONE - keep)
                through[n] *= keep
                reach[n] += weight * middles[i]
                for c in range(channels):
                    inputs[c, n] += weight * field[1 + c, i]
            for a in range(count):
                n = active[a]
                if through[n] >= least_through and t[n] < end[n]:
                    active[left_over] = n
                    left_over += 1
            count = left_over
        for n in range(TILE):
            if top + n // SIDE >= height or left + n % SIDE >= width:
                continue
            for c in range(channels):
                inputs[c, n] += through[n] * background[c]
            x, y, z = rays[n, 3], rays[n, 4], rays[n, 5]
            unit = _ONE / np.sqrt(x * x + y * y + z * z)
            write_spherical_harmonics(x * unit, y * unit, z * unit, bands, inputs, channels, n)
        dense(c1, d1, inputs, decoded, True)
        dense(c2, d2, decoded, colours, False)
        for n in range(TILE):
            row, column = top + n // SIDE, left + n % SIDE
            if row >= height or column >= width:
                continue
            for c in range(3):
                rgb[image, row, column, c] = _ONE / (_ONE + np.exp(-colours[c, n]))
            opacity = _ONE - through[n]
            alpha[image, row, column] = opacity
            depth_m[image, row, column] = scale[n] * reach[n] / opacity if opacity > _f(1e-3) else _f(np.inf)
    return total
