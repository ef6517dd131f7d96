"""Adam as torch computes it, without torch's class: making one of those imports torch's compiler, two seconds of every new process."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.optim.adam import adam

_BETA_1, _BETA_2, _EPSILON = 0.9, 0.999, 1e-8  # Kingma and Ba 2015, and torch's own


class Adam:
    """A theta that moves against gradients.

    Args:
        tensors: ``theta`` to begin with, or all `tensors` of one that is to go on; copied.
        learning_rate: Step.

    Attributes:
        theta: Where it is; each step changes it in place.
    """

    def __init__(self, tensors: Mapping[str, Tensor], learning_rate: float) -> None:
        kept = {name: tensor.detach().clone() for name, tensor in tensors.items()}
        self.theta = kept.pop("theta")
        self._rate = learning_rate
        self._moments = kept or {
            "step": torch.tensor(0.0),
            "exp_avg": torch.zeros_like(self.theta),
            "exp_avg_sq": torch.zeros_like(self.theta),
        }

    @torch.no_grad()
    def step(self, gradient: Tensor) -> None:
        """Move against a gradient of theta's shape and type."""
        at = self._moments
        adam(
            [self.theta], [gradient], [at["exp_avg"]], [at["exp_avg_sq"]], [], [at["step"]], foreach=False,
            amsgrad=False, beta1=_BETA_1, beta2=_BETA_2, lr=self._rate, weight_decay=0.0, eps=_EPSILON, maximize=False,
        )  # fmt: skip

    @property
    def tensors(self) -> dict[str, Tensor]:
        """Theta and moments by the names of torch's state, copied."""
        return {
            "theta": self.theta.clone(),
            **{name: tensor.clone() for name, tensor in self._moments.items()},
        }
