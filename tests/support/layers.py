"""Image layers as dense tensors with their derivatives: what tests compare the sparse layers with."""

from typing import Any

import numpy as np
import torch

from advnerf_core.render.composite import visible_shares
from advnerf_core.render.soft_pose import LEAST_TRANSMITTANCE, soft_layer


def composite(premultiplied, alphas, depths_m):
    """Premultiplied colour ``[..., C]``, alpha and alpha-weighted depth (infinite where alpha is 0) of layers ``[L, ...]``."""
    shares = visible_shares(alphas, depths_m)
    weights = shares * alphas
    alpha = weights.sum(0)
    depth = torch.where(weights > 0, weights * depths_m, torch.zeros_like(weights)).sum(0)
    depth = torch.where(alpha > 0, depth / alpha.clamp_min(torch.finfo(alpha.dtype).tiny), torch.inf)
    return (shares[..., None] * premultiplied).sum(0), alpha, depth


def render_soft(field, placement, theta, poses, pinhole, supersample=2, least=LEAST_TRANSMITTANCE):
    """`soft_layer` as dense layers ``[B, H, W]``: colour and alpha with a derivative by placement and colours, depth without."""
    return _RenderSoft.apply(placement, field.colours(theta), (field, poses, pinhole, supersample, least))


class _RenderSoft(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, placement, colours, settings):
        field, poses, pinhole, supersample, least = settings
        layer = soft_layer(
            field, placement.detach(), colours.detach().numpy(), poses, pinhole, supersample, least
        )
        ctx.layer, ctx.types = layer, (placement.dtype, colours.dtype)
        shape = (len(poses), pinhole.height, pinhole.width)
        dense = np.zeros((int(np.prod(shape)), 5))
        dense[:, 4] = np.inf
        dense[layer.pixels] = np.column_stack([layer.colour, layer.alpha, layer.depth_m])
        image = torch.from_numpy(dense.reshape(*shape, 5))
        out = image[..., :3].clone(), image[..., 3].clone(), image[..., 4].clone()
        ctx.mark_non_differentiable(out[2])
        return out

    @staticmethod
    def backward(ctx: Any, *grads):
        pixels = torch.from_numpy(ctx.layer.pixels)
        slopes = torch.cat([grads[0].reshape(-1, 3)[pixels], grads[1].reshape(-1, 1)[pixels]], dim=1)
        by_place, by_colour = ctx.layer.pull(slopes.double().numpy())
        return torch.from_numpy(by_place).to(ctx.types[0]), torch.from_numpy(by_colour).to(ctx.types[1]), None
