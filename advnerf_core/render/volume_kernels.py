"""CPU kernels of volume rendering over packed samples: weights, accumulation, and the gradient.

With optical depths ``tau_i = sigma_i dt_i``: ``T_i = exp(-sum_{j<i} tau_j)``, ``w_i = T_i (1 - exp(-tau_i))``, ``F = sum_i w_i f_i`` and
``alpha = sum_i w_i`` (Max 1995, "Optical models for direct volume rendering"). Samples beyond ``T = MIN_TRANSMITTANCE`` are dropped.
Samples lie in tiles ``[tiles, channels, TILE]``; channel 0 is the logarithm of density, the others are features, squashed to (-1, 1) by
``x / (1 + |x|)``: were they unbounded, thin fog with huge features could imitate surfaces.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.fields.mlp_kernels import TILE
from advnerf_core.parallel import KERNEL_OPTIONS

Array32 = NDArray[np.float32]
Array64i = NDArray[np.int64]

MIN_TRANSMITTANCE = 1e-4
MAX_LOG_DENSITY = 15.0  # exp(15) per box side is opaque within a millimetre of a ten-metre room
_f = np.float32
_ONE = np.float32(1.0)
_STOP = np.float32(MIN_TRANSMITTANCE)
_TOP = np.float32(MAX_LOG_DENSITY)


@njit(**KERNEL_OPTIONS)
def mark_visible(
    log_density: Array32,
    widths: Array32,
    begins: Array64i,
    first: int,
    stop: int,
    least: np.float32,
    keep: NDArray[np.bool_],
) -> None:
    """Mark the samples of rays ``first..stop`` that are visible in the image.

    Args:
        log_density: Tiles ``[tiles, >= 1, TILE]``, channel 0.
        widths: Interval of each sample in box coordinates ``[N]``.
        begins: First sample of each ray ``[R + 1]``.
        first: First ray.
        stop: One past the last ray.
        least: Smallest weight that counts.
        keep: ``[N]``, written.
    """
    for r in range(first, stop):
        through = _ONE
        for n in range(begins[r], begins[r + 1]):
            if through < _STOP:
                keep[n] = False
                continue
            held = np.exp(-np.exp(min(log_density[n // TILE, 0, n % TILE], _TOP)) * widths[n])
            keep[n] = through * (_ONE - held) >= least
            through *= held


@njit(**KERNEL_OPTIONS)
def squash_features(field: Array32) -> None:
    """Replace channels 1 and up of one tile ``[1 + C, TILE]`` by ``x / (1 + |x|)``."""
    for c in range(1, field.shape[0]):
        for n in range(TILE):
            field[c, n] /= _ONE + abs(field[c, n])


@njit(**KERNEL_OPTIONS)
def gather_columns(tiles: Array32, columns: Array64i, first: int, stop: int, out: Array32) -> None:
    """Copy columns of ``tiles [*, K, TILE]`` to columns ``first..stop`` of ``out [*, K, TILE]``."""
    rows, begin = np.uint64(tiles.shape[1] * TILE), first
    flat, found = tiles.reshape(-1), np.empty(TILE, np.uint64)
    while begin < stop:
        # One tile of results at a time, of which neighbours are written in a row.
        block, column = begin // TILE, begin % TILE
        count = min(TILE - column, stop - begin)
        for n in range(count):
            source = np.uint64(columns[begin + n])
            found[n] = source // np.uint64(TILE) * rows + source % np.uint64(TILE)
        for k in range(tiles.shape[1]):
            row = np.uint64(k * TILE)
            for n in range(count):
                out[block, k, column + n] = flat[found[n] + row]
        begin += count


@njit(**KERNEL_OPTIONS)
def accumulate(
    field: Array32,
    widths: Array32,
    begins: Array64i,
    first: int,
    stop: int,
    weights: Array32,
    out: Array32,
    alpha: Array32,
) -> None:
    """Composite rays ``first..stop``.

    Args:
        field: ``[tiles, 1 + C, TILE]``.
        widths: Interval of each sample in box coordinates ``[N]``.
        begins: First sample of each ray ``[R + 1]``.
        first: First ray.
        stop: One past the last ray.
        weights: ``[N]``, written; zero where a ray has already stopped.
        out: Accumulated features in tiles of rays ``[ray tiles, >= C, TILE]``, rows ``0..C`` written.
        alpha: Opacity ``[R]``, written.
    """
    channels = field.shape[1] - 1
    for r in range(first, stop):
        block, column = r // TILE, r % TILE
        for c in range(channels):
            out[block, c, column] = _f(0.0)
        through = _ONE
        for n in range(begins[r], begins[r + 1]):
            if through < _STOP:
                weights[n] = _f(0.0)
                continue
            tile, lane = n // TILE, n % TILE
            keep = np.exp(-np.exp(min(field[tile, 0, lane], _TOP)) * widths[n])
            weight = through * (_ONE - keep)
            through *= keep
            weights[n] = weight
            for c in range(channels):
                out[block, c, column] += weight * field[tile, 1 + c, lane]
        alpha[r] = _ONE - through


@njit(**KERNEL_OPTIONS)
def accumulate_backward(
    field: Array32, widths: Array32, begins: Array64i, first: int, stop: int, weights: Array32, grad_out: Array32,
    grad_alpha: Array32, grad_weights: Array32,
) -> None:  # fmt: skip
    """Replace ``field`` by its gradient, with respect to features before squashing, for rays ``first..stop``.

    Args:
        field: ``[tiles, 1 + C, TILE]``, overwritten.
        widths: ``[N]``.
        begins: ``[R + 1]``.
        first: First ray.
        stop: One past the last ray.
        weights: ``[N]`` from ``accumulate``.
        grad_out: ``[ray tiles, >= C, TILE]``.
        grad_alpha: ``[R]``.
        grad_weights: Direct gradient of the loss with respect to each weight ``[N]``; overwritten with the full one.
    """
    channels = field.shape[1] - 1
    for r in range(first, stop):
        block, column = r // TILE, r % TILE
        total = _f(0.0)
        for n in range(begins[r], begins[r + 1]):
            tile, lane = n // TILE, n % TILE
            weight = weights[n]
            g = grad_alpha[r] + grad_weights[n]
            for c in range(channels):
                g += grad_out[block, c, column] * field[tile, 1 + c, lane]
                slope = _ONE - abs(field[tile, 1 + c, lane])
                field[tile, 1 + c, lane] = weight * grad_out[block, c, column] * slope * slope
            grad_weights[n] = g
            total += weight * g
        # dF/dtau_i = T_{i+1} g_i - sum_{j>i} w_j g_j, and the second sum is the total less what has been passed.
        through = _ONE
        for n in range(begins[r], begins[r + 1]):
            tile, lane = n // TILE, n % TILE
            weight, raw = weights[n], field[tile, 0, lane]
            through -= weight
            total -= weight * grad_weights[n]
            depth = np.exp(min(raw, _TOP)) * widths[n]
            # Dropped samples, and those past the clamp, do not move the image.
            moves = weight > _f(0.0) and raw < _TOP
            field[tile, 0, lane] = depth * (through * grad_weights[n] - total) if moves else _f(0.0)


@njit(**KERNEL_OPTIONS)
def add_distortion_gradient(
    weights: Array32,
    middles: Array32,
    widths: Array32,
    begins: Array64i,
    first: int,
    stop: int,
    scale: np.float32,
    grad_weights: Array32,
) -> None:
    """Gradient of the distortion loss, which pulls the weights of a ray together into one surface.

    ``L = sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 d_i`` per ray (Barron et al. 2022, "Mip-NeRF 360", equation 15), in linear
    time since samples are sorted. Differentiated with respect to weights only: samples are fixed.

    Args:
        weights: ``[N]``.
        middles: Positions of samples along their rays, any unit ``[N]``.
        widths: Their intervals in the same unit ``[N]``.
        begins: First sample of each ray ``[R + 1]``.
        first: First ray.
        stop: One past the last ray.
        scale: Factor on the gradient.
        grad_weights: ``[N]``, added to.
    """
    for r in range(first, stop):
        total, moment = _f(0.0), _f(0.0)
        for n in range(begins[r], begins[r + 1]):
            total += weights[n]
            moment += weights[n] * middles[n]
        before, moment_before = _f(0.0), _f(0.0)
        for n in range(begins[r], begins[r + 1]):
            w, m = weights[n], middles[n]
            after, moment_after = total - before - w, moment - moment_before - w * m
            apart = m * (before - after) - (moment_before - moment_after)
            grad_weights[n] += scale * (_f(2.0) * apart + _f(2.0 / 3.0) * w * widths[n])
            before += w
            moment_before += w * m
