"""Signed cross-track error as a differentiable torch function."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from advnerf_core.driving.path import Path


class _CrossTrack(torch.autograd.Function):
    """Closed-form projection forward; backward along the path's left normal."""

    @staticmethod
    def forward(ctx: Any, xy: Tensor, path: Path) -> Tensor:
        projection = path.project(xy.detach().cpu().double().numpy())
        ctx.save_for_backward(torch.as_tensor(projection.normal, dtype=xy.dtype, device=xy.device))
        return torch.as_tensor(projection.cte_m, dtype=xy.dtype, device=xy.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (normal,) = ctx.saved_tensors
        return grads[0][..., None] * normal, None


def cross_track(path: Path, xy_m: Tensor) -> Tensor:
    """Signed cross-track error ``[...]`` [m], left positive, of positions ``xy_m [..., 2]`` [m], float32 or float64.

    The projection is computed in float64. The gradient is the path normal at the nearest point, exact where the nearest
    point is unique. Differentiable once.
    """
    result: Tensor = _CrossTrack.apply(xy_m, path)
    return result
