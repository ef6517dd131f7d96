"""The memory of policies from files: named inputs and outputs carried from image to image, as one array for each car."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from advnerf_core.policies.arrays import array_module
from advnerf_core.strict import StrictModel


class NetworkState(StrictModel):
    """One state of a file's memory.

    Attributes:
        input: Name of the input for the state.
        output: Name of the output with the next state.
        initial: Value before the first image; one number for all elements, or one for each in the order of the input's own layout.
        batch_axis: Axis of the batch in the input and the output; 1 for the states of ``torch.nn.LSTM`` and ``GRU``.
    """

    input: str = Field(min_length=1)
    output: str = Field(min_length=1)
    initial: float | tuple[float, ...] = 0.0
    batch_axis: int = Field(default=0, ge=0)


@dataclass(frozen=True)
class CarriedState:
    """A state with its shape.

    Attributes:
        shape: Shape of the input without the batch's axis.
        one_by_one: Whether its batch size is fixed to one.
    """

    declared: NetworkState
    shape: tuple[int, ...]
    one_by_one: bool

    @property
    def size(self) -> int:
        """Number of elements for one car."""
        return prod(self.shape)


def initial_memory(states: tuple[CarriedState, ...], batch: int) -> NDArray[np.float32]:
    """Memory ``[B, K]`` before the first image: the elements of all states."""
    rows = [
        np.broadcast_to(np.asarray(each.declared.initial, np.float32), (batch, each.size)) for each in states
    ]
    return np.concatenate(rows, axis=1)


def split(states: tuple[CarriedState, ...], memory: Any) -> dict[str, Any]:
    """The inputs by name, in their own shapes, from a memory ``[B, K]`` (numpy or torch; differentiable)."""
    module, parts, first = array_module(memory), {}, 0
    for state in states:
        piece = memory[:, first : first + state.size].reshape(len(memory), *state.shape)
        parts[state.declared.input] = module.moveaxis(piece, 0, state.declared.batch_axis)
        first += state.size
    return parts


def joined(states: tuple[CarriedState, ...], outputs: dict[str, Any]) -> Any:
    """The memory ``[B, K]`` from the outputs by name (numpy or torch; differentiable)."""
    rows = []
    for state in states:
        output = outputs[state.declared.output]
        output = array_module(output).moveaxis(output, state.declared.batch_axis, 0)
        rows.append(output.reshape(len(output), -1))
    return array_module(rows[0]).concatenate(rows, 1)
