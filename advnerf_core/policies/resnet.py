"""A small residual network as the policy.

He et al., "Deep Residual Learning for Image Recognition" (2016), with the pre-activation blocks of He et al., "Identity Mappings in Deep
Residual Networks" (2016). Group normalisation (Wu and He, "Group Normalization", 2018) replaces batch normalisation, so that an output does
not depend on the other images of its batch and train and eval mode compute the same. SiLU replaces ReLU, so that all layers are smooth.
"""

from __future__ import annotations

from itertools import pairwise
from math import gcd

from torch import Tensor, nn

from advnerf_core.policies.architecture import ResNetConfiguration
from advnerf_core.policies.network import FeaturesAndHead
from advnerf_core.policies.view import IMAGE_HEIGHT, IMAGE_WIDTH

_GROUPS = 8


class ResNet(FeaturesAndHead):
    """A convolution, residual stages that each halve the image, and two linear layers.

    The features are flattened and not averaged over the image, because steering depends on where the track is seen. The goal joins them.
    """

    Configuration = ResNetConfiguration

    def __init__(
        self,
        goal_size: int = 0,
        max_steering_rad: float = 0.30,
        configuration: ResNetConfiguration | None = None,
    ) -> None:
        super().__init__(goal_size, max_steering_rad, configuration)
        settings: ResNetConfiguration = self.configuration
        layers: list[nn.Module] = [nn.Conv2d(3, settings.widths[0], 5, 2, 2)]
        for before, after in pairwise(settings.widths):
            layers.append(_ResidualBlock(before, after, 2))
            layers += [_ResidualBlock(after, after, 1) for _ in range(settings.blocks - 1)]
        self.features = nn.Sequential(*layers, _normalised(settings.widths[-1]), nn.SiLU(), nn.Flatten())
        height, width = IMAGE_HEIGHT, IMAGE_WIDTH
        for _ in settings.widths:
            height, width = (height + 1) // 2, (width + 1) // 2
        flat = settings.widths[-1] * height * width
        self.head = nn.Sequential(
            nn.Linear(flat + goal_size, settings.hidden), nn.SiLU(), nn.Linear(settings.hidden, 1)
        )
        self.raise_goal_weights(flat)


class _ResidualBlock(nn.Module):
    """Two convolutions beside a shortcut; the shortcut is a 1x1 convolution where the size changes."""

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        self.residual = nn.Sequential(
            _normalised(channels),
            nn.SiLU(),
            nn.Conv2d(channels, width, 3, stride, 1),
            _normalised(width),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, 1, 1),
        )
        same = channels == width and stride == 1
        self.shortcut = nn.Identity() if same else nn.Conv2d(channels, width, 1, stride)

    def forward(self, features: Tensor) -> Tensor:
        """Features ``[B, width, H / stride, W / stride]`` of ``[B, channels, H, W]``."""
        output: Tensor = self.shortcut(features) + self.residual(features)
        return output


def _normalised(channels: int) -> nn.Module:
    return nn.GroupNorm(gcd(_GROUPS, channels), channels)
