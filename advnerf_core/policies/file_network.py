"""A policy file as a network: images, goals and memory are fed to the inputs that its declaration names, for every kind of file."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from advnerf_core.policies.arrays import array_module
from advnerf_core.policies.contract import PolicyContractError
from advnerf_core.policies.memory import initial_memory, joined, split
from advnerf_core.policies.tensors import Tensors


class FileNetwork(ABC):
    """Base of the networks of policy files; a subclass runs the file.

    Args:
        tensors: Inputs and outputs of the file with their uses.
    """

    training = False

    def __init__(self, tensors: Tensors) -> None:
        self.tensors = tensors

    @abstractmethod
    def run(self, feeds: Mapping[str, Any], outputs: list[str]) -> list[Any]:
        """Compute outputs by name from inputs by name, which are floating-point arrays of any type.

        Raises:
            Exception: The inputs do not fit the file.
        """

    def initial_memory(self, batch: int) -> Any:
        """Memory ``[B, K]`` before the first image, of a file with states."""
        return initial_memory(self.tensors.states, batch)

    def __call__(self, images: Any, goals: Any = None, memory: Any = None) -> Any:
        """Raw output ``[B, ...]`` for images in the file's layout; for a file with states also the next memory."""
        if self.tensors.one_by_one and len(images) != 1:
            given = [images, goals, memory]
            answers = [
                self(*(None if each is None else each[row : row + 1] for each in given))
                for row in range(len(images))
            ]
            join = array_module(images).concatenate
            if not self.tensors.states:
                return join(answers, 0)
            return join([each[0] for each in answers], 0), join([each[1] for each in answers], 0)
        feeds = {self.tensors.image.name: images}
        if self.tensors.goal is not None:
            feeds[self.tensors.goal.name] = goals
        states = self.tensors.states
        if states:
            feeds |= split(states, memory)
        names = [self.tensors.steering.name, *(each.declared.output for each in states)]
        try:
            raw, *following = self.run(feeds, names)
        except Exception as error:  # the runtimes' exceptions have no common base
            reason = " ".join(str(error).split())
            raise PolicyContractError(
                f"expected the file to take {[list(each.shape) for each in feeds.values()]}, but it wants "
                f"{', '.join(map(str, self.tensors.inputs))}; correct size and layout in the declaration ({reason:.120})"
            ) from error
        # Squeezed to one number, which can only be this image's.
        if self.tensors.one_by_one and raw.ndim == 0:
            raw = raw.reshape(1)
        return (raw, joined(states, dict(zip(names[1:], following, strict=True)))) if states else raw
