"""A torch policy for the live node."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.policies.adapter import adapted
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.driver import Driver
from advnerf_core.policies.network import images_to_tensor
from advnerf_core.policies.policy_file import LoadedPolicy


class TorchDriver(Driver):
    """Drives by a torch policy."""

    def __init__(self, loaded: LoadedPolicy) -> None:
        plain = PolicyContract(loaded.view, goal_size=int(loaded.policy.goal_size))
        policy = adapted(loaded.policy, plain)
        super().__init__(policy.network, policy.contract, loaded.sha256)

    @torch.inference_mode()
    def answer(self, image: NDArray[np.uint8], goal: tuple[float, ...]) -> Tensor:
        """The network's raw output for one policy image, as the declaration's methods expect it."""
        goals = torch.tensor([goal], dtype=torch.float32) if goal else None
        raw: Tensor = self._after(images_to_tensor(image), goals)
        return raw
