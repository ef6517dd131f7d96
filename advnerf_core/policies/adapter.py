"""Wraps a network of any origin as the policy that rollouts, attacks and the live node use."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from advnerf_core.policies.answer import answer, memory_before
from advnerf_core.policies.contract import PolicyContract, PolicyContractError


class AdaptedPolicy(nn.Module):
    """A network with its declaration.

    It takes over the network's mode when it is wrapped: it never puts a network into eval mode silently.

    Args:
        network: Called as in `advnerf_core.policies.answer`; a network with memory also has ``initial_memory(batch)``. A network that
            queries another program has an attribute ``identity``, a text that names that program.

    Attributes:
        stateless: Whether the steering depends on the present image and goal only.
        identity: Name of the queried program; empty for a network that runs here. Such a policy is not fixed: the program may change.
    """

    def __init__(self, network: Callable[..., Any], contract: PolicyContract) -> None:
        super().__init__()
        if not contract.stateless and not hasattr(network, "initial_memory"):
            raise PolicyContractError(
                "expected a network that is not stateless to have initial_memory(batch), got one without; add it, or declare "
                "stateless = True if the output depends on the present image only"
            )
        if (contract.input_name or contract.states) and not hasattr(network, "tensors"):
            raise PolicyContractError(
                "expected input_name and states for an .onnx or .pt2 file only; remove them, and hand the memory through "
                "forward(images, goals, memory)"
            )
        self.network = network
        self.contract = contract
        self.stateless = not contract.has_memory
        self.differentiable = contract.differentiable
        self.goal_size = contract.goal_size
        self.identity = str(getattr(network, "identity", ""))
        self.training = bool(getattr(network, "training", False))

    def initial_memory(self, batch: int) -> Tensor:
        """Memory ``[B, ...]`` before the first image, of a policy that is not stateless."""
        memory: Tensor = memory_before(self.contract, self.network, batch, torch.empty(0))
        return memory

    def forward(self, images: Tensor, goals: Tensor | None = None, memory: Tensor | None = None) -> Any:
        """Steering ``[B]`` [rad], left positive, of images ``[B, 3, H, W]`` RGB 0..1; with memory also the next memory."""
        self._check_goals(goals, len(images))
        raw, memory = answer(self.contract, self.network, images, goals, memory)
        steering = self.contract.to_steering_rad(raw, len(images))
        if not isinstance(steering, Tensor):
            raise PolicyContractError(
                f"expected steering as a tensor of torch from the network, got {type(steering).__name__}; return one, as torch.from_numpy makes it"
            )
        return steering if self.stateless else (steering, memory)

    def answers(self, unit_rad: float = 1e-3) -> list[int]:
        """Steering for three fixed pictures in whole units, which identifies what no weights tell."""
        generator = torch.Generator().manual_seed(0)
        pictures = torch.rand(3, 3, *self.contract.size, generator=generator)
        pictures[0] = 0.5
        goals = torch.eye(3, self.goal_size) if self.goal_size else None
        with torch.no_grad():
            if self.stateless:
                steering = self(pictures, goals)
            else:
                steering, _ = self(pictures, goals, self.initial_memory(3))
        return [round(float(each) / unit_rad) for each in steering]

    def described_tensors(self) -> list[tuple[str, str]]:
        """Name and use of each input and output with its shape, from the file, else from the contract."""
        contract, tensors = self.contract, getattr(self.network, "tensors", None)
        if tensors is not None:
            rows = [("input", each) for each in tensors.inputs] + [
                ("output", each) for each in tensors.outputs
            ]
            return [(what, f"{each}: {tensors.use_of(each, contract.meaning)}") for what, each in rows]
        goals = [("input", f"goals [B, {self.goal_size}]")] if self.goal_size else []
        columns = "[B] or [B, 1]" if contract.output_column is None else "[B, N]"
        return [
            ("input", f"images [B, {', '.join(map(str, contract.input_shape))}]"),
            *goals,
            ("output", f"{columns}: {contract.meaning}"),
        ]

    def _check_goals(self, goals: Tensor | None, batch: int) -> None:
        shape = None if goals is None else tuple(goals.shape)
        if shape != (None if self.goal_size == 0 else (batch, self.goal_size)):
            raise PolicyContractError(f"expected goals [{batch}, {self.goal_size}] (0: none), got {shape}")


def adapt(network: Callable[..., Any], contract: PolicyContract) -> AdaptedPolicy:
    """Wrap a network, in eval mode with its weights, with its declaration; the return value of a ``package.module:factory``."""
    return AdaptedPolicy(network, contract)


def adapted(policy: Any, contract: PolicyContract) -> AdaptedPolicy:
    """The policy itself if it is adapted, else a wrapper around a policy that already fulfils the contract."""
    return policy if isinstance(policy, AdaptedPolicy) else AdaptedPolicy(policy, contract)
