"""CPU kernels of perceptron layers on tiles of samples.

Memory is tiled and feature-major, ``[tiles, features, TILE]``: the innermost loop runs over the samples of a tile with a constant trip
count, so it vectorises for any layer width. Two outputs by four inputs are taken per pass, which keeps the multiply-add
units busy between loads and stores; therefore output widths are even and input widths multiples of four.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.parallel import KERNEL_OPTIONS

Array32 = NDArray[np.float32]

TILE = 256  # samples: 64 hidden features are 64 KiB, which stays in the second-level cache
_ZERO = np.float32(0.0)


@njit(**KERNEL_OPTIONS)
def dense(weight: Array32, bias: Array32, x: Array32, y: Array32, relu: bool) -> None:
    """``y = weight @ x + bias``, with an optional rectifier.

    Args:
        weight: ``[J, K]``, J even, K a multiple of 4.
        bias: ``[J]``.
        x: ``[K, TILE]``.
        y: ``[J, TILE]``.
        relu: Whether negative results become 0.
    """
    for j in range(0, weight.shape[0], 2):
        for n in range(TILE):
            y[j, n] = bias[j]
            y[j + 1, n] = bias[j + 1]
        for k in range(0, weight.shape[1], 4):
            v0, v1, v2, v3 = weight[j, k], weight[j, k + 1], weight[j, k + 2], weight[j, k + 3]
            w0, w1, w2, w3 = (
                weight[j + 1, k],
                weight[j + 1, k + 1],
                weight[j + 1, k + 2],
                weight[j + 1, k + 3],
            )
            for n in range(TILE):
                a, b, c, d = x[k, n], x[k + 1, n], x[k + 2, n], x[k + 3, n]
                y[j, n] += a * v0 + b * v1 + c * v2 + d * v3
                y[j + 1, n] += a * w0 + b * w1 + c * w2 + d * w3
        if relu:
            for n in range(TILE):
                y[j, n] = max(y[j, n], _ZERO)
                y[j + 1, n] = max(y[j + 1, n], _ZERO)


@njit(**KERNEL_OPTIONS)
def dense_transposed(weight_t: Array32, grad: Array32, mask: Array32, grad_x: Array32, relu: bool) -> None:
    """Input gradient of ``dense``: ``grad_x = weight^T @ grad``, zero where the rectified ``mask`` is zero.

    Args:
        weight_t: Transposed weight ``[K, J]``, K even, J a multiple of 4.
        grad: ``[J, TILE]``.
        mask: Rectified input ``[K, TILE]``; read only if ``relu``.
        grad_x: ``[K, TILE]``.
        relu: Whether the input came out of a rectifier.
    """
    for k in range(0, weight_t.shape[0], 2):
        for n in range(TILE):
            grad_x[k, n] = _ZERO
            grad_x[k + 1, n] = _ZERO
        for j in range(0, weight_t.shape[1], 4):
            v0, v1, v2, v3 = weight_t[k, j], weight_t[k, j + 1], weight_t[k, j + 2], weight_t[k, j + 3]
            w0, w1, w2, w3 = (
                weight_t[k + 1, j],
                weight_t[k + 1, j + 1],
                weight_t[k + 1, j + 2],
                weight_t[k + 1, j + 3],
            )
            for n in range(TILE):
                a, b, c, d = grad[j, n], grad[j + 1, n], grad[j + 2, n], grad[j + 3, n]
                grad_x[k, n] += a * v0 + b * v1 + c * v2 + d * v3
                grad_x[k + 1, n] += a * w0 + b * w1 + c * w2 + d * w3
        if relu:
            for n in range(TILE):
                grad_x[k, n] = grad_x[k, n] if mask[k, n] > _ZERO else _ZERO
                grad_x[k + 1, n] = grad_x[k + 1, n] if mask[k + 1, n] > _ZERO else _ZERO


@njit(**KERNEL_OPTIONS)
def add_outer(grad: Array32, x: Array32, grad_weight: Array32, grad_bias: Array32) -> None:
    """Weight gradients of ``dense``: ``grad_weight += grad x^T`` and ``grad_bias += sum(grad)``.

    Args:
        grad: ``[J, TILE]``, J even.
        x: ``[K, TILE]``, K a multiple of 4.
        grad_weight: ``[J, K]``, accumulated into.
        grad_bias: ``[J]``, accumulated into.
    """
    for j in range(0, grad_weight.shape[0], 2):
        s0, s1 = _ZERO, _ZERO
        for n in range(TILE):
            s0 += grad[j, n]
            s1 += grad[j + 1, n]
        grad_bias[j] += s0
        grad_bias[j + 1] += s1
        for k in range(0, grad_weight.shape[1], 4):
            s0, s1, s2, s3 = _ZERO, _ZERO, _ZERO, _ZERO
            r0, r1, r2, r3 = _ZERO, _ZERO, _ZERO, _ZERO
            for n in range(TILE):
                a, b, c, d = x[k, n], x[k + 1, n], x[k + 2, n], x[k + 3, n]
                g, h = grad[j, n], grad[j + 1, n]
                s0 += g * a
                s1 += g * b
                s2 += g * c
                s3 += g * d
                r0 += h * a
                r1 += h * b
                r2 += h * c
                r3 += h * d
            grad_weight[j, k] += s0
            grad_weight[j, k + 1] += s1
            grad_weight[j, k + 2] += s2
            grad_weight[j, k + 3] += s3
            grad_weight[j + 1, k] += r0
            grad_weight[j + 1, k + 1] += r1
            grad_weight[j + 1, k + 2] += r2
            grad_weight[j + 1, k + 3] += r3
