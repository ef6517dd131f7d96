"""Depth-ordered composition of layers: ``C = C_1 + (1 - a_1) C_2 + (1 - a_1)(1 - a_2) C_3 ...``, nearest first, per pixel.

Colours are premultiplied by alpha. Depth is planar z in the camera frame [m].
"""

from __future__ import annotations

import torch
from torch import Tensor


def visible_shares(alphas: Tensor, depths_m: Tensor) -> Tensor:
    """What each layer keeps of its light: the product of ``1 - alpha`` over all layers in front of it.

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
    shares = torch.ones_like(alphas)
    for behind in range(len(alphas)):
        for front in range(len(alphas)):
            if front == behind:
                continue
            nearer = depths_m[front] < depths_m[behind] if front > behind else depths_m[front] <= depths_m[behind]
            shares[behind] *= torch.where(nearer, 1.0 - alphas[front], 1.0)
    return shares


def composite(premultiplied: Tensor, alphas: Tensor, depths_m: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compose layers to one premultiplied image.

    Args:
        premultiplied: Colours times alpha, ``[L, ..., C]``.
        alphas: ``[L, ...]``.
        depths_m: ``[L, ...]`` [m].

    Returns:
        Premultiplied colour ``[..., C]``, alpha ``[...]`` and alpha-weighted depth ``[...]`` (infinite where alpha is 0).
    """
    shares = visible_shares(alphas, depths_m)
    weights = shares * alphas
    alpha = weights.sum(0)
    depth = torch.where(weights > 0, weights * depths_m, torch.zeros_like(weights)).sum(0)
    depth = torch.where(alpha > 0, depth / alpha.clamp_min(torch.finfo(alpha.dtype).tiny), torch.inf)
    return (shares[..., None] * premultiplied).sum(0), alpha, depth
