"""A policy for the live node: one image after the other. No torch here: the car's computer needs none for an ONNX file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.errors import ConfigError
from advnerf_core.policies.answer import answer, memory_before
from advnerf_core.policies.contract import PolicyContract


def require_goal(goal: Sequence[float], size: int, advice: str) -> None:
    """Raise a `ConfigError`, which ends with ``advice``, unless a goal has as many numbers as the policy takes."""
    if len(goal) != size:
        raise ConfigError(f"expected a goal of {size} numbers for this policy, got {len(goal)}; {advice}")


class Driver:
    """Drives with a network of numpy arrays. A policy's memory is carried from image to image, until `reset`.

    Args:
        network: Called as in `advnerf_core.policies.answer`.
        sha256: Hash of the policy.
    """

    def __init__(self, network: Any, contract: PolicyContract, sha256: str) -> None:
        self.contract, self.view, self.goal_size = contract, contract.view, contract.goal_size
        self.sha256 = sha256
        self._network = network
        self._memory: Any = None

    def steer(self, image: NDArray[np.uint8], goal: tuple[float, ...]) -> float:
        """Steering [rad], left positive, of one policy image ``[H, W, 3]`` uint8 RGB."""
        return self.command(image, goal)[0]

    def command(self, image: NDArray[np.uint8], goal: tuple[float, ...]) -> tuple[float, float | None]:
        """Steering as in `steer`, and the speed implied by the waypoints [m/s]; None for a policy without waypoints."""
        raw, trajectory = self.answer(image, goal), self.contract.trajectory
        steering_rad = float(self.contract.to_steering_rad(raw, 1)[0])
        if trajectory is None:
            return steering_rad, None
        return steering_rad, float(trajectory.speed_mps(self.contract.waypoints_m(raw, 1))[0])

    def answer(self, image: NDArray[np.uint8], goal: tuple[float, ...]) -> Any:
        """The network's raw output for one policy image, as the declaration's methods expect it."""
        images = np.moveaxis(image, -1, 0)[None].astype(np.float32) / np.float32(255.0)
        return self._after(images, np.array([goal], dtype=np.float32) if goal else None)

    def reset(self) -> None:
        """Forget earlier images."""
        self._memory = None

    def _after(self, images: Any, goals: Any) -> Any:
        if self._memory is None and self.contract.has_memory:
            self._memory = memory_before(self.contract, self._network, 1, images)
        raw, self._memory = answer(self.contract, self._network, images, goals, self._memory)
        return raw
