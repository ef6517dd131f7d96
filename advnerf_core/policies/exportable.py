"""A network in the form that exporters need: tensors in, the output that steers and the next memory out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from advnerf_core.policies.answer import one_output
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.memory import NetworkState


@dataclass(frozen=True, eq=False)
class Exportable:
    """A network ready for export.

    Attributes:
        network: Called with ``examples``.
        examples: Inputs for a batch of two.
        contract: The declaration without names in the file.
        initial: Memory of one car before the first image; empty for a network without memory.
    """

    network: Any
    examples: tuple[Tensor, ...]
    inputs: list[str]
    outputs: list[str]
    contract: PolicyContract
    initial: tuple[float, ...] = ()

    def declared(self, memory: str, next_memory: str, steering: str | None = None) -> PolicyContract:
        """The declaration of the file with these names of the memory."""
        if not self.initial:
            return self.contract
        state = NetworkState(input=memory, output=next_memory, initial=self.initial)
        return replace(self.contract, states=(state,), output_name=steering)


def exportable(network: Any, contract: PolicyContract) -> Exportable:
    """The network behind a declaration, in eval mode, in the form that exporters need."""
    images = contract.first_input(
        torch.rand(2, 3, *contract.size, generator=torch.Generator().manual_seed(0))
    )
    examples, inputs = [images], ["images"]
    if contract.goal_size:
        examples, inputs = [*examples, torch.zeros(2, contract.goal_size)], [*inputs, "goals"]
    plain = replace(contract, output_name=None, output_index=None)
    if contract.stateless:
        network = network if plain == contract else _OfTensors(network, contract)
        return Exportable(network, tuple(examples), inputs, ["steering"], plain)
    memory = network.initial_memory(2)
    return Exportable(
        _OfTensors(network, contract),
        (*examples, memory),
        [*inputs, "memory"],
        ["steering", "next_memory"],
        plain,
        tuple(memory[0].flatten().tolist()),
    )


class _OfTensors(nn.Module):
    """A network with one output that steers, whose inputs are all tensors."""

    def __init__(self, network: Any, contract: PolicyContract) -> None:
        super().__init__()
        self.network, self.contract = network, contract
        self.eval()

    def forward(self, images: Tensor, second: Tensor | None = None, third: Tensor | None = None) -> Any:
        """Output for images, then goals and memory if any, in this order; with a memory also the next one."""
        if self.contract.stateless:
            raw = self.network(images) if second is None else self.network(images, second)
            return one_output(self.contract, raw)
        goals, memory = (None, second) if third is None else (second, third)
        raw, memory = self.network(images, goals, memory)
        return one_output(self.contract, raw), memory
