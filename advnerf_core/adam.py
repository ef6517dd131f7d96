"""Adam as torch computes it, without torch's class: making one of those imports torch's compiler, two seconds of every new process."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.optim.adam import adam

_BETA_1, _BETA_2, _EPSILON = 0.9, 0.999, 1e-8  # Kingma and Ba 2015, and torch's own


class Adam:
    """Parameters that move against gradients.

    Args:
        parameters: By name; each step changes them in place.
        moments: Those of each parameter that `moments` gave, by its name and then by torch's, to go on from; copied. A parameter
            without them begins.
        weight_decay: Share of a parameter that a step of rate 1 takes away, apart from its gradient (Loshchilov and Hutter 2019).
        fused: All parameters in one pass, with sums rounded a little differently; as ``fused`` of torch's classes.

    Attributes:
        moments: ``step``, ``exp_avg`` and ``exp_avg_sq`` of each parameter, as they are.
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
        """Move against gradients of the parameters' shapes and types; those in ``grad`` unless told, which are taken away."""
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
