"""A network of your own as the policy: trained on a painted line here, and by every command that trains.

    .venv/bin/python examples/my_architecture.py
    .venv/bin/advnerf experiment run examples/warehouse.experiment.yaml --setting tiny --folder runs/mine --set policy.architecture=my_architecture.py:Mixer

The class holds the layers and turns images into one number. SteeringNetwork checks the inputs and bounds the steering.
"""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor, nn

from advnerf_core import Pinhole, PolicyView
from advnerf_core.learning.fit import FitConfig, fit, mean_absolute_error
from advnerf_core.learning.frames import Frames, FrameSet
from advnerf_core.policies.architecture import Architecture
from advnerf_core.policies.network import SteeringNetwork
from advnerf_core.policies.policy_file import load_policy, save_policy


@dataclass(frozen=True)
class Settings:
    """Settings of the network: keys of ``policy.configuration``."""

    width: int = 32


class Mixer(SteeringNetwork):
    """Mean colours of a grid of cells, and two linear layers."""

    Configuration = Settings

    def __init__(self, goal_size: int, max_steering_rad: float, configuration: Settings) -> None:
        super().__init__(goal_size, max_steering_rad, configuration)
        width = configuration.width
        self.cells = nn.Sequential(nn.AvgPool2d((11, 10)), nn.Flatten())
        self.head = nn.Sequential(nn.Linear(360 + goal_size, width), nn.SiLU(), nn.Linear(width, 1))

    def output(self, images: Tensor, goals: Tensor | None) -> Tensor:
        """Output ``[B]`` of images ``[B, 3, 66, 200]`` in 0..1 and goals ``[B, goal_size]``."""
        features = self.cells(2.0 * images - 1.0)
        if goals is not None:
            features = torch.cat([features, goals], dim=1)
        output: Tensor = self.head(features)[:, 0]
        return output


def painted_frames(count: int) -> Frames:
    """Grey images with a white line; the farther left it is, the farther left is the steering."""
    rng = np.random.default_rng(0)
    columns = rng.integers(20, 180, count)
    images = rng.integers(90, 110, (count, 66, 200, 3)).astype(np.uint8)
    for image, column in zip(images, columns, strict=True):
        image[30:, column - 4 : column + 4] = 250
    steering_rad = (0.25 * (100 - columns) / 80).astype(np.float32)
    goals = np.zeros((count, 0), np.float32)
    return Frames(images, np.zeros((count, 3)), steering_rad, goals, np.zeros(count, bool))


if __name__ == "__main__":
    torch.manual_seed(0)
    policy = Architecture(f"{__file__}:Mixer", {"width": 48}).build(goal_size=0, max_steering_rad=0.3)
    frames = FrameSet([painted_frames(256)], True, holdout_every=4)
    fit(policy, frames, FitConfig(steps=150, batch_size=32))
    with TemporaryDirectory() as folder:
        file = Path(folder) / "policy.safetensors"
        save_policy(file, policy, PolicyView(Pinhole(336, 188, 174.0, 174.0, 168.0, 94.0)), {})
        loaded = load_policy(file).policy
    print(
        f"mean error on held-out frames {mean_absolute_error(loaded, frames):.3f} rad, of labels up to 0.25 rad"
    )
