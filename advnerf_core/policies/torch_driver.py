"""A torch policy as the live node uses it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.policies.network import images_to_tensor
from advnerf_core.policies.policy_file import LoadedPolicy


class TorchDriver:
    """Drives by a torch policy, and keeps the memory of one that has any from image to image."""

    def __init__(self, loaded: LoadedPolicy) -> None:
        self._policy = loaded.policy
        self.view = loaded.view
        self.goal_size = int(loaded.policy.goal_size)
        self.sha256 = loaded.sha256
        self._memory: Tensor | None = None
        self.reset()

    def steer(self, image: NDArray[np.uint8], goal: tuple[float, ...]) -> float:
        """Steering [rad] of one policy image ``[H, W, 3]`` uint8 RGB."""
        goals = torch.tensor([goal], dtype=torch.float32) if goal else None
        with torch.inference_mode():
            if self._memory is None:
                return float(self._policy(images_to_tensor(image), goals)[0])
            steering, self._memory = self._policy(images_to_tensor(image), goals, self._memory)
        return float(steering[0])

    def reset(self) -> None:
        """Forget the images so far."""
        self._memory = None if self._policy.stateless else self._policy.initial_memory(1)
