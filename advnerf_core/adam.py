"""Adam with torch's results but without torch's class, whose first instance imports torch's compiler, two seconds of every new process."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.optim.adam import adam

_BETA_1, _BETA_2, _EPSILON = 0.9, 0.999, 1e-8  # Kingma and Ba 2015, as in torch


class Adam:
    """Parameters with their moments of Adam.

    Args:
        parameters: Parameters by name; each step changes them in place.
        moments: Moments to resume from, as in the attribute, by the parameter's name and then by torch's name; copied. A parameter
            without them starts fresh.
        weight_decay: Share of a parameter that a step of rate 1 takes away, apart from its gradient (Loshchilov and Hutter 2019).
        fused: All parameters in one pass, with sums rounded a little differently, like ``fused`` of torch's classes.

    Attributes:
        moments: ``step``, ``exp_avg`` and ``exp_avg_sq`` of each parameter, not copied.
    """

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        moments: Mapping[str, Mapping[str, Tensor]] | None = None,
        weight_decay: float = 0.0,
        fused: bool = False,
    ) -> None:
        self._parameters = dict(parameters)
        self._decay, self._fused = weight_decay, fused
        self.moments = {
            name: _begun(parameter, (moments or {}).get(name, {}))
            for name, parameter in self._parameters.items()
        }

    @torch.no_grad()
    def step(self, learning_rate: float, gradients: Mapping[str, Tensor] | None = None) -> None:
        """Take a step against gradients of the parameters' shapes and types; by default against those in ``grad``, which are cleared."""
        if gradients is None:
            gradients = {name: each.grad for name, each in self._parameters.items() if each.grad is not None}
        moments = [self.moments[name] for name in gradients]
        adam(
            [self._parameters[name] for name in gradients], list(gradients.values()),
            [kept["exp_avg"] for kept in moments], [kept["exp_avg_sq"] for kept in moments], [], [kept["step"] for kept in moments],
            foreach=False, fused=self._fused, amsgrad=False, beta1=_BETA_1, beta2=_BETA_2, lr=learning_rate,
            weight_decay=self._decay, decoupled_weight_decay=True, eps=_EPSILON, maximize=False,
        )  # fmt: skip
        for parameter in self._parameters.values():
            parameter.grad = None


def _begun(parameter: Tensor, moments: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The moments of a parameter, copied in its layout."""
    value = parameter.detach()
    own = {
        "step": torch.tensor(0.0),
        "exp_avg": torch.zeros_like(value),
        "exp_avg_sq": torch.zeros_like(value),
    }
    for name, tensor in own.items():
        if moments:
            tensor.copy_(moments[name])
    return own
