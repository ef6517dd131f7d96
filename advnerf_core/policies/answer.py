"""Calls a network behind a declaration: images in, its raw output and the next memory out, for numpy and torch alike.

A network is called as ``network(images)``, with goals as ``network(images, goals)``, and with memory as
``network(images, goals, memory) -> (output, memory)``. The memory of a policy that sees several images is one row for each car: the past
images, then the memory of the network itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import prod
from typing import Any

from advnerf_core.policies.arrays import array_module, like
from advnerf_core.policies.contract import PolicyContract, PolicyContractError


def memory_before(contract: PolicyContract, network: Any, batch: int, images: Any) -> Any:
    """Memory of a policy before the first image, as an array of the images' kind; None for a policy without memory."""
    own = None if contract.stateless else network.initial_memory(batch)
    if contract.frames is None:
        return own
    past = contract.frames.initial(batch, contract.size).reshape(batch, -1)
    past = like(images if own is None else own, past)
    return past if own is None else array_module(past).concatenate([past, own.reshape(batch, -1)], 1)


def answer(
    contract: PolicyContract, network: Any, images: Any, goals: Any = None, memory: Any = None
) -> tuple[Any, Any]:
    """The network's raw output for images ``[B, 3, H, W]`` RGB 0..1, and the memory after them.

    Args:
        goals: ``[B, goal_size]``; None for a policy without goals.
        memory: From `memory_before` or the last call; None for a policy without memory.
    """
    past, own = None, memory
    if contract.frames is not None:
        shape = (contract.frames.past, 3, *contract.size)
        past, own = memory[:, : prod(shape)], memory[:, prod(shape) :]
        images, past = contract.frames.push(images, past.reshape(len(memory), *shape))
    given = contract.to_network(images)
    if contract.stateless:
        return one_output(contract, network(given) if goals is None else network(given, goals)), _row(past)
    if past is not None:
        own = own.reshape(network.initial_memory(len(memory)).shape)
    raw, own = network(given, goals, own)
    if past is not None:
        own = array_module(past).concatenate([_row(past), _row(own)], 1)
    return one_output(contract, raw), own


def _row(memory: Any) -> Any:
    return None if memory is None else memory.reshape(len(memory), -1)


def one_output(contract: PolicyContract, raw: Any) -> Any:
    """The declared output of a network that returns several."""
    key: Any = contract.output_name if contract.output_name is not None else contract.output_index
    if not isinstance(raw, Mapping | list | tuple):
        return raw
    names = list(raw) if isinstance(raw, Mapping) else list(range(len(raw)))
    if key is None and len(names) == 1 and hasattr(raw[names[0]], "shape"):
        return raw[names[0]]
    if isinstance(raw, list | tuple) and raw and all(isinstance(each, int | float) for each in raw):
        raise PolicyContractError(
            "expected an array of steering [B] or [B, 1], got a list of numbers; return one array"
        )
    if key not in names:
        how = "output_name" if isinstance(raw, Mapping) else "output_index"
        raise PolicyContractError(
            f"expected a network with one output, got {len(names)}; declare {how}, one of {names}, or return what steers"
        )
    return raw[key]
