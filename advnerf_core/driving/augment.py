"""Image augmentation for training: what differs between cameras and between a surrogate and a camera, not the geometry."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor


@dataclass(frozen=True)
class AugmentConfig:
    """Strength of each change; every image of a batch draws its own. Zero switches one off.

    Attributes:
        brightness: Largest added grey level, of a 0..1 range.
        contrast: Largest relative change of contrast about mid grey.
        gamma: Largest logarithmic change of the tone curve's exponent.
        colour: Largest relative gain change of a single channel.
        noise: Standard deviation of Gaussian pixel noise; each image draws its own level up to this.
        blur_share: Share of the images that are blurred by a 3x3 binomial filter.
        shift_px: Largest shift in whole pixels, both axes; one pixel is about 0.5 degrees.
    """

    brightness: float = 0.10
    contrast: float = 0.20
    gamma: float = 0.25
    colour: float = 0.08
    noise: float = 0.03
    blur_share: float = 0.35
    shift_px: int = 1


def augment(images: Tensor, config: AugmentConfig, generator: torch.Generator) -> Tensor:
    """Changed copies of ``images [B, 3, H, W]`` RGB 0..1; the same generator state gives the same result."""
    count = images.shape[0]

    def uniform(channels: int = 1) -> Tensor:
        return torch.rand(count, channels, 1, 1, generator=generator, dtype=images.dtype) * 2.0 - 1.0

    result = _shift(images, config.shift_px, generator)
    result = _blur_some(result, config.blur_share, generator)
    exponent = torch.exp(config.gamma * uniform())
    gain = (1.0 + config.contrast * uniform()) * (1.0 + config.colour * uniform(3))
    offset = 0.5 + config.brightness * uniform()
    result = (result.clamp(1e-4, 1.0).pow(exponent) - 0.5) * gain + offset
    if config.noise > 0.0:
        level = config.noise * torch.rand(count, 1, 1, 1, generator=generator, dtype=images.dtype)
        result = result + level * torch.randn(result.shape, generator=generator, dtype=images.dtype)
    return result.clamp(0.0, 1.0)


def _shift(images: Tensor, reach_px: int, generator: torch.Generator) -> Tensor:
    if reach_px <= 0:
        return images
    # One shift for the whole batch: it is a slice instead of a gather, and batches are small against the data.
    dx, dy = torch.randint(0, 2 * reach_px + 1, (2,), generator=generator).tolist()
    padded = F.pad(images, (reach_px,) * 4, mode="replicate")
    return padded[..., dy : dy + images.shape[2], dx : dx + images.shape[3]]


def _blur_some(images: Tensor, share: float, generator: torch.Generator) -> Tensor:
    chosen = torch.rand(images.shape[0], generator=generator) < share
    if not bool(chosen.any()):
        return images
    some = F.pad(images[chosen], (1, 1, 1, 1), mode="replicate")
    rows = 0.25 * some[..., :-2, :] + 0.5 * some[..., 1:-1, :] + 0.25 * some[..., 2:, :]
    result = images.clone()
    result[chosen] = 0.25 * rows[..., :-2] + 0.5 * rows[..., 1:-1] + 0.25 * rows[..., 2:]
    return result
