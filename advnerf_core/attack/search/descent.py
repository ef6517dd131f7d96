"""Descent of a theta by Adam, and its tensors in a state file."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from advnerf_core.adam import Adam


class Descent:
    """State of a descent.

    Args:
        tensors: ``theta`` to begin with, or all `tensors` of a descent to resume; copied.

    Attributes:
        theta: Current point; each step changes it in place.
    """

    def __init__(self, tensors: Mapping[str, Tensor], learning_rate: float) -> None:
        self.theta = tensors["theta"].detach().clone()
        moments = {name: tensor for name, tensor in tensors.items() if name != "theta"}
        self._adam, self._rate = Adam({"theta": self.theta}, {"theta": moments}), learning_rate

    def step(self, gradient: Tensor) -> None:
        """Move against a gradient of theta's shape and type."""
        self._adam.step(self._rate, {"theta": gradient})

    @property
    def tensors(self) -> dict[str, Tensor]:
        """Theta and moments, copied."""
        moments = self._adam.moments["theta"]
        return {"theta": self.theta.clone(), **{name: tensor.clone() for name, tensor in moments.items()}}
