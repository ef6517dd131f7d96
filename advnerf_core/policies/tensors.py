"""Assigns the inputs and outputs of a policy file: as declared, or by their shapes if these allow one reading only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.memory import CarriedState, NetworkState

UINT8 = "uint8"
FLOATS = ("float16", "float32", "float64")
_GOAL_RANK = 2


@dataclass(frozen=True)
class TensorInfo:
    """An input or output of a policy file.

    Attributes:
        shape: Dimensions; a text or None is a variable dimension. None if the file does not say.
        kind: Type of its elements, by numpy's name.
    """

    name: str
    shape: tuple[int | str | None, ...] | None
    kind: str

    def __str__(self) -> str:
        dimensions = "of any shape" if self.shape is None else f"[{', '.join(str(d) for d in self.shape)}]"
        return f"{self.name} {dimensions} {self.kind}"

    def may_have_rank(self, rank: int) -> bool:
        """Whether the file allows this number of dimensions."""
        return self.shape is None or len(self.shape) == rank


@dataclass(frozen=True)
class Tensors:
    """Inputs and outputs of a policy file with their uses.

    Attributes:
        goal: The input for the goals; None for a policy without a goal.
    """

    inputs: tuple[TensorInfo, ...]
    outputs: tuple[TensorInfo, ...]
    image: TensorInfo
    goal: TensorInfo | None
    steering: TensorInfo
    states: tuple[CarriedState, ...] = ()

    @property
    def one_by_one(self) -> bool:
        """Whether the file accepts only one image at a time."""
        return (self.image.shape or ())[:1] == (1,) or any(each.one_by_one for each in self.states)

    def use_of(self, tensor: TensorInfo, meaning: str) -> str:
        """Use of a tensor as text; the used output has the declaration's ``meaning``."""
        if tensor is self.steering:
            return meaning
        for state in self.states:
            if tensor.name in (state.declared.input, state.declared.output):
                return f"memory, {state.declared.output} to {state.declared.input}"
        return "images" if tensor is self.image else "goals" if tensor is self.goal else "not used"


def chosen_tensors(
    inputs: Sequence[TensorInfo], outputs: Sequence[TensorInfo], contract: PolicyContract, path: Path
) -> Tensors:
    """Inputs and outputs as the declaration uses them.

    Raises:
        PolicyContractError: The declaration does not fit the file, or leaves more than one reading.
    """
    states = tuple(_carried(inputs, outputs, state, path) for state in contract.states)
    taken = {state.input for state in contract.states}
    image, goal = _chosen_inputs([each for each in inputs if each.name not in taken], contract, path)
    _check_image(image, contract, path)
    if goal is not None and goal.kind not in FLOATS:
        raise PolicyContractError(f"{path}: expected goals of {', '.join(FLOATS)}, got {goal}")
    given = {state.output for state in contract.states}
    steering = _chosen_output(outputs, given, contract, path)
    return Tensors(tuple(inputs), tuple(outputs), image, goal, steering, states)


def _carried(
    inputs: Sequence[TensorInfo], outputs: Sequence[TensorInfo], state: NetworkState, path: Path
) -> CarriedState:
    """A state with its shape in the file."""
    given = _named(inputs, state.input, "states.input", path)
    _named(outputs, state.output, "states.output", path)
    shape = list(given.shape or ())
    if state.batch_axis < len(shape):
        del shape[state.batch_axis]
    sizes = tuple(each for each in shape if isinstance(each, int))
    if not given.shape or len(sizes) != len(given.shape) - 1 or given.kind not in FLOATS:
        raise PolicyContractError(
            f"{path}: states: expected {', '.join(FLOATS)} of fixed sizes but for the batch on axis {state.batch_axis}, got {given}; correct "
            "batch_axis, or export it with fixed sizes"
        )
    carried = CarriedState(state, sizes, given.shape[state.batch_axis] == 1)
    if isinstance(state.initial, tuple) and len(state.initial) != carried.size:
        raise PolicyContractError(
            f"{path}: states.initial: expected one number or {carried.size} for {given}, got {len(state.initial)}"
        )
    return carried


def _chosen_inputs(
    inputs: Sequence[TensorInfo], contract: PolicyContract, path: Path
) -> tuple[TensorInfo, TensorInfo | None]:
    wanted = "1 input (images)" if contract.goal_size == 0 else "2 inputs (images, goals)"
    if len(inputs) != 1 + (contract.goal_size > 0):
        raise PolicyContractError(
            f"expected {wanted} in {path}, got {_listed(inputs)}; declare goal_size or states, or export a network without the other inputs"
        )
    if contract.input_name is not None:
        image = _named(inputs, contract.input_name, "input_name", path)
    else:
        fitting = [
            each
            for each in inputs
            if each.may_have_rank(1 + len(contract.input_shape))
            and all(other is each or other.may_have_rank(_GOAL_RANK) for other in inputs)
        ]
        if len(fitting) != 1 and len(inputs) > 1:
            raise PolicyContractError(
                f"{path} has the inputs {_listed(inputs)}; declare input_name: the one that takes the images"
            )
        image = inputs[0] if not fitting else fitting[0]
    return image, next((each for each in inputs if each is not image), None)


def _check_image(image: TensorInfo, contract: PolicyContract, path: Path) -> None:
    if image.kind not in (*FLOATS, UINT8):
        raise PolicyContractError(f"{path}: expected images of {', '.join((*FLOATS, UINT8))}, got {image}")
    if image.kind == UINT8 and (contract.value_max, set(contract.mean), set(contract.std)) != (
        255.0,
        {0.0},
        {1.0},
    ):
        raise PolicyContractError(
            f"{path}: expected value_max 255, mean 0 and std 1 for the uint8 input {image}, "
            f"got {contract.value_max:g}, {list(contract.mean)} and {list(contract.std)}; leave these keys out"
        )
    if image.shape is None:
        return
    if isinstance(batch := (image.shape or (None,))[0], int) and batch != 1:
        raise PolicyContractError(
            f"{path}: expected an input for any number of images, or for one, got {image}: it takes {batch} at a time; export it with a dynamic batch, or "
            "with a batch of 1"
        )
    expected = contract.input_shape
    fits = len(image.shape) == 1 + len(expected) and all(
        not isinstance(has, int) or has == wants for has, wants in zip(image.shape[1:], expected, strict=True)
    )
    if not fits:
        raise PolicyContractError(
            f"{path}: expected an input of [B, {', '.join(map(str, expected))}] ({contract.layout}, {contract.colour_space}), got {image}; "
            "correct size, layout, frames or colour_space in the declaration"
        )


def _chosen_output(
    outputs: Sequence[TensorInfo], states: set[str], contract: PolicyContract, path: Path
) -> TensorInfo:
    free = [each for each in outputs if each.name not in states]
    if contract.output_name is not None:
        steering = _named(outputs, contract.output_name, "output_name", path)
    elif contract.output_index is not None:
        if contract.output_index >= len(outputs):
            raise PolicyContractError(
                f"{path}: output_index: expected 0 to {len(outputs) - 1} of {_listed(outputs)}, got {contract.output_index}"
            )
        steering = outputs[contract.output_index]
    elif len(free) == 1:
        steering = free[0]
    else:
        raise PolicyContractError(
            f"{path} has the outputs {_listed(free)}; declare output_name: the one that steers"
        )
    columns = steering.shape[1] if steering.shape is not None and len(steering.shape) == 2 else None
    if isinstance(columns, int) and contract.trajectory is None:
        _check_columns(steering, columns, contract, path)
    return steering


def _check_columns(steering: TensorInfo, columns: int, contract: PolicyContract, path: Path) -> None:
    if contract.bins is not None:
        if columns != len(contract.bins.values):
            raise PolicyContractError(
                f"{path}: bins.values: expected {columns} for the output {steering}, got {len(contract.bins.values)}"
            )
    elif contract.output_column is None and columns > 1:
        raise PolicyContractError(
            f"{path}: the output {steering} has {columns} columns; declare output_column: the one that steers, 0 to {columns - 1}; or what all "
            "of them are: trajectory or bins"
        )
    elif contract.output_column is not None and contract.output_column >= columns:
        raise PolicyContractError(
            f"{path}: output_column: expected 0 to {columns - 1} for the output {steering}, got {contract.output_column}"
        )


def _named(tensors: Sequence[TensorInfo], name: str, key: str, path: Path) -> TensorInfo:
    found = next((each for each in tensors if each.name == name), None)
    if found is None:
        raise PolicyContractError(f"{path}: {key}: expected one of {_listed(tensors)}; got {name!r}")
    return found


def _listed(tensors: Sequence[TensorInfo]) -> str:
    return ", ".join(map(str, tensors)) or "none"
