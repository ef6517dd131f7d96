"""PilotNet, the default architecture of policies.

Bojarski et al., "End to End Learning for Self-Driving Cars" (2016): a 200x66 image, five convolutions (the first three with stride 2), then
linear layers down to one steering value.
"""

from __future__ import annotations

from itertools import pairwise

from torch import nn

from advnerf_core.policies.architecture import PilotNetConfiguration
from advnerf_core.policies.network import FeaturesAndHead

# (channels, kernel, stride) of each convolution, Bojarski et al. figure 4.
CONVOLUTIONS = ((24, 5, 2), (36, 5, 2), (48, 5, 2), (64, 3, 1), (64, 3, 1))
FLAT_FEATURES = 64 * 1 * 18


class PilotNet(FeaturesAndHead):
    """PilotNet with smooth activations, an optional goal vector and bounded steering.

    Every layer is smooth (ELU is continuously differentiable), so finite differences confirm its gradients. It has no
    dropout and no batch statistics: train and eval mode compute the same. The colour scaling to [-1, 1] is inside.
    The goal joins the flattened features.
    """

    Configuration = PilotNetConfiguration
    rows_independent = True

    def __init__(
        self,
        goal_size: int = 0,
        max_steering_rad: float = 0.30,
        configuration: PilotNetConfiguration | None = None,
    ) -> None:
        super().__init__(goal_size, max_steering_rad, configuration)
        layers: list[nn.Module] = []
        channels = 3
        for width, kernel, stride in CONVOLUTIONS:
            layers += [nn.Conv2d(channels, width, kernel, stride), nn.ELU()]
            channels = width
        self.features = nn.Sequential(*layers, nn.Flatten())
        widths = [FLAT_FEATURES + goal_size, *self.configuration.hidden]
        linear: list[nn.Module] = []
        for fan_in, fan_out in pairwise(widths):
            linear += [nn.Linear(fan_in, fan_out), nn.ELU()]
        self.head = nn.Sequential(*linear, nn.Linear(widths[-1], 1))
        self.raise_goal_weights(FLAT_FEATURES)
