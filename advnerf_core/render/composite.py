"""Depth-ordered composition of layers: ``C = C_1 + (1 - a_1) C_2 + (1 - a_1)(1 - a_2) C_3 ...``, nearest first, per pixel.

Colours are premultiplied by alpha. Depth is planar z in the camera frame [m]. Dense layers are tensors that cover all pixels;
sparse ones, such as objects, list the pixels that they cover: the work then grows with the covered pixels, not with the layers
times the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.geometry import Array
from advnerf_core.parallel import KERNEL_OPTIONS


def visible_shares(alphas: Tensor, depths_m: Tensor) -> Tensor:
    """Share of its light that each layer keeps: the product of ``1 - alpha`` over all layers in front of it.

    Args:
        alphas: ``[L, ...]`` in 0..1.
        depths_m: ``[L, ...]`` [m]; where alpha is 0 it does not matter, and may be infinite. Equal depths keep the order of
            the layers.

    Returns:
        Shares ``[L, ...]``. Not differentiable with respect to depth (the order is discrete).
    """
    if alphas.shape != depths_m.shape:
        raise ValueError(
            f"expected alphas and depths of one shape, got {list(alphas.shape)} and {list(depths_m.shape)}"
        )
    # Pairs instead of a sort: a scene has few layers, and a sort along the short axis is ten times slower.
    shares = []
    for behind in range(len(alphas)):
        share = torch.ones_like(alphas[behind])
        for front in range(len(alphas)):
            if front != behind:
                nearer = (
                    depths_m[front] < depths_m[behind]
                    if front > behind
                    else depths_m[front] <= depths_m[behind]
                )
                share = share * torch.where(nearer, 1.0 - alphas[front], 1.0)
        shares.append(share)
    return torch.stack(shares) if shares else torch.ones_like(alphas)


def sparse_shares(
    pixels: Sequence[NDArray[np.int64]],
    alphas: Sequence[Array],
    depths_m: Sequence[Array],
    background_depth_m: Array,
) -> tuple[Array, list[Array]]:
    """:func:`visible_shares` of layers that cover few pixels each, before an opaque background that covers all.

    Args:
        pixels: Pixels that each layer covers ``[P]``, each at most once.
        alphas: ``[P]`` each, in 0..1.
        depths_m: ``[P]`` each [m]. At equal depth a layer is before the background, and before later layers.
        background_depth_m: ``[N]`` [m]; NaN is infinitely far.

    Returns:
        The background's share ``[N]``, and the layers' shares ``[P]``, all float64.
    """
    lengths = [len(part) for part in pixels]
    where, alpha, depth = (
        np.concatenate([np.zeros(0, kind), *parts]).astype(kind, copy=False)
        for kind, parts in ((np.int64, pixels), (np.float64, alphas), (np.float64, depths_m))
    )
    if not len(where) == len(alpha) == len(depth):
        raise ValueError(
            f"expected as many alphas and depths as pixels, got {len(where)}, {len(alpha)} and {len(depth)}"
        )
    behind = np.ascontiguousarray(background_depth_m, dtype=np.float64)
    if len(where) and not 0 <= where.min() <= where.max() < len(behind):
        raise ValueError(f"expected pixels within 0..{len(behind) - 1}, got {where.min()}..{where.max()}")
    ends = np.cumsum(np.bincount(where, minlength=len(behind)))
    background, shares = np.ones(len(behind)), np.empty(len(where))
    _layer_shares(where, alpha, depth, behind, ends, np.empty(len(where), np.int64), background, shares)
    return background, np.split(shares, np.cumsum(lengths)[:-1]) if lengths else []


@njit(**KERNEL_OPTIONS)
def _layer_shares(
    where: Any, alpha: Any, depth: Any, behind: Any, ends: Any, order: Any, background: Any, shares: Any
) -> None:
    """Sort the entries by pixel, and within a pixel by depth; ``ends`` is used up."""
    for n in range(
        len(where) - 1, -1, -1
    ):  # backwards, so that entries of a pixel keep the order of the layers
        ends[where[n]] -= 1
        order[ends[where[n]]] = n
    first = 0
    while first < len(order):
        pixel, last = where[order[first]], first + 1
        while last < len(order) and where[order[last]] == pixel:
            entry, place = order[last], last
            while place > first and depth[order[place - 1]] > depth[entry]:
                order[place] = order[place - 1]
                place -= 1
            order[place] = entry
            last += 1
        light = 1.0
        for k in range(first, last):
            n = order[k]
            if depth[n] > behind[pixel]:  # never true for NaN
                shares[n] = 0.0
                continue
            shares[n] = light
            light *= 1.0 - alpha[n]
        background[pixel] = light
        first = last
