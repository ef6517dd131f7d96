"""CPU kernels of perceptron layers on tiles of samples.

Memory is tiled and feature-major, ``[tiles, features, TILE]``: neighbouring samples of one feature are a vector. The products run over
blocks of outputs by samples whose sums stay in registers, see `vector_blocks`; therefore widths are even.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.fields.vector_blocks import (
    LANES,
    OUTER_COLUMNS,
    OUTER_ROWS,
    ROWS,
    outer_block,
    product_block,
)
from advnerf_core.parallel import KERNEL_OPTIONS

Array32 = NDArray[np.float32]

TILE = 256  # samples: 64 hidden features are 64 KiB, which stays in the second-level cache
_ZERO = np.float32(0.0)
_PLAIN, _RECTIFIED, _MASKED = 0, 1, 2  # endings of a product

_product, _product_pair = product_block(ROWS), product_block(2)
_rectified, _rectified_pair = product_block(ROWS, "rectified"), product_block(2, "rectified")
_masked, _masked_pair = product_block(ROWS, "masked"), product_block(2, "masked")
_outer, _outer_pair = outer_block(OUTER_ROWS, OUTER_COLUMNS), outer_block(2, OUTER_COLUMNS)


@njit(**KERNEL_OPTIONS)
def dense(weight: Array32, bias: Array32, x: Array32, y: Array32, relu: bool) -> None:
    """``y = weight @ x + bias``, with an optional rectifier.

    Args:
        weight: ``[J, K]``, J even.
        bias: ``[J]``.
        x: ``[K, TILE]``.
        y: ``[J, TILE]``.
        relu: Whether negative results become 0.
    """
    _multiply(weight, bias, x, y, y, _RECTIFIED if relu else _PLAIN)


@njit(**KERNEL_OPTIONS)
def dense_transposed(weight_t: Array32, grad: Array32, mask: Array32, grad_x: Array32, relu: bool) -> None:
    """Input gradient of ``dense``: ``grad_x = weight^T @ grad``, zero where the rectified ``mask`` is zero.

    Args:
        weight_t: Transposed weight ``[K, J]``, K even.
        grad: ``[J, TILE]``.
        mask: Rectified input ``[K, TILE]``; read only if ``relu``.
        grad_x: ``[K, TILE]``.
        relu: Whether the input came out of a rectifier.
    """
    bias = np.zeros(len(weight_t), np.float32)
    _multiply(weight_t, bias, grad, grad_x, mask, _MASKED if relu else _PLAIN)


@njit(**KERNEL_OPTIONS)
def _multiply(weight, bias, x, y, mask, ending):  # type: ignore[no-untyped-def]
    """``y = weight @ x + bias`` in blocks, with an ending of `product_block`."""
    rows, length = weight.shape
    whole = rows - rows % ROWS
    for n in range(0, TILE, LANES):
        for j in range(0, whole, ROWS):
            if ending == _RECTIFIED:
                _rectified(weight, bias, x, y, mask, j, n, length, TILE)
            elif ending == _MASKED:
                _masked(weight, bias, x, y, mask, j, n, length, TILE)
            else:
                _product(weight, bias, x, y, mask, j, n, length, TILE)
        for j in range(whole, rows, 2):
            if ending == _RECTIFIED:
                _rectified_pair(weight, bias, x, y, mask, j, n, length, TILE)
            elif ending == _MASKED:
                _masked_pair(weight, bias, x, y, mask, j, n, length, TILE)
            else:
                _product_pair(weight, bias, x, y, mask, j, n, length, TILE)


@njit(**KERNEL_OPTIONS)
def add_outer(grad: Array32, x: Array32, grad_weight: Array32, grad_bias: Array32) -> None:
    """Weight gradients of ``dense``: ``grad_weight += grad x^T`` and ``grad_bias += sum(grad)``.

    Args:
        grad: ``[J, TILE]``, J even.
        x: ``[K, TILE]``, K even.
        grad_weight: ``[J, K]``, accumulated into.
        grad_bias: ``[J]``, accumulated into.
    """
    rows, length = grad_weight.shape
    whole = rows - rows % OUTER_ROWS
    for j in range(rows):
        total = _ZERO
        for n in range(TILE):
            total += grad[j, n]
        grad_bias[j] += total
    for j in range(0, whole, OUTER_ROWS):
        for k in range(0, length, OUTER_COLUMNS):
            _outer(grad, x, grad_weight, j, k, length, TILE)
    for j in range(whole, rows, 2):
        for k in range(0, length, OUTER_COLUMNS):
            _outer_pair(grad, x, grad_weight, j, k, length, TILE)
