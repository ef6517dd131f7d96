"""A small vision transformer as the policy.

Dosovitskiy et al., "An Image is Worth 16x16 Words: Transformers for Image Recognition at Scale" (2021): an image is a row of patches, one
token each, and a class token whose last state is read out. The blocks follow Vaswani et al., "Attention Is All You Need" (2017), with
normalisation before each part. Positions begin as sines and cosines of row and column, which learn faster than random ones (Beyer, Zhai and
Kolesnikov, "Better plain ViT baselines for ImageNet-1k", 2022). There is no dropout: train and eval mode compute the same.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from advnerf_core.policies.architecture import VisionTransformerConfiguration
from advnerf_core.policies.network import SteeringNetwork
from advnerf_core.policies.view import IMAGE_HEIGHT, IMAGE_WIDTH

_SPREAD = 0.02  # initial spread of the class token
_LONGEST = 100.0  # longest over shortest wavelength of positions, as in Beyer et al.
_EXPANSION = 2


class VisionTransformer(SteeringNetwork):
    """Patches, transformer blocks, and a linear read-out of the class token. The goal is added to the class token."""

    Configuration = VisionTransformerConfiguration

    def __init__(
        self,
        goal_size: int = 0,
        max_steering_rad: float = 0.30,
        configuration: VisionTransformerConfiguration | None = None,
    ) -> None:
        super().__init__(goal_size, max_steering_rad, configuration)
        settings: VisionTransformerConfiguration = self.configuration
        height, width = settings.patch
        self.patches = nn.Conv2d(3, settings.width, settings.patch, settings.patch)
        self.first = nn.Parameter(_SPREAD * torch.randn(1, 1, settings.width))
        self.positions = nn.Parameter(_waves(IMAGE_HEIGHT // height, IMAGE_WIDTH // width, settings.width))
        self.goal = nn.Linear(goal_size, settings.width) if goal_size else None
        self.blocks = nn.Sequential(
            *(_TransformerBlock(settings.width, settings.heads) for _ in range(settings.depth))
        )
        self.head = nn.Sequential(nn.LayerNorm(settings.width), nn.Linear(settings.width, 1))

    def output(self, images: Tensor, goals: Tensor | None) -> Tensor:
        """Unbounded output ``[B]`` of images ``[B, 3, 66, 200]`` in 0..1 and goals ``[B, goal_size]``."""
        tokens = self.patches(images * 2.0 - 1.0).flatten(2).transpose(1, 2) + self.positions
        first = self.first.expand(len(images), -1, -1)
        if self.goal is not None and goals is not None:
            first = first + self.goal(goals)[:, None]
        seen = self.blocks(torch.cat([first, tokens], dim=1))
        output: Tensor = self.head(seen[:, 0])[:, 0]
        return output


class _TransformerBlock(nn.Module):
    """Self-attention, then two linear layers for each token; both are added to their input."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.mixed = nn.Linear(width, width)
        self.perceptron = nn.Sequential(
            nn.LayerNorm(width),
            nn.Linear(width, _EXPANSION * width),
            nn.GELU(),
            nn.Linear(_EXPANSION * width, width),
        )

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens ``[B, N, width]``."""
        batch, count, width = tokens.shape
        stacked = self.query_key_value(self.norm(tokens)).reshape(batch, count, 3, self.heads, -1)
        query, key, value = stacked.permute(2, 0, 3, 1, 4)
        attended = scaled_dot_product_attention(query, key, value)
        tokens = tokens + self.mixed(attended.transpose(1, 2).reshape(batch, count, width))
        output: Tensor = tokens + self.perceptron(tokens)
        return output


def _waves(rows: int, columns: int, width: int) -> Tensor:
    """Positions ``[1, rows * columns, width]``: a quarter each of sines and cosines of the row, and of the column."""
    frequencies = _LONGEST ** -(torch.arange(width // 4) / (width // 4))

    def along(count: int) -> Tensor:
        phases = torch.arange(count)[:, None] * frequencies
        return torch.cat([phases.sin(), phases.cos()], dim=1)

    shape = (rows, columns, width // 2)
    both = [along(rows)[:, None].expand(shape), along(columns)[None].expand(shape)]
    return torch.cat(both, dim=2).reshape(1, rows * columns, width)
