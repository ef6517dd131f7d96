"""Guesses the declaration of a policy file from its tensors, and asks for the rest, which only its author knows."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from advnerf_core.geometry import Pinhole
from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.declaration import find_declaration
from advnerf_core.policies.frames import FrameStack
from advnerf_core.policies.load import wrong_policy
from advnerf_core.policies.memory import NetworkState
from advnerf_core.policies.tensors import FLOATS, UINT8, TensorInfo
from advnerf_core.policies.tracker import TrackedTrajectory
from advnerf_core.policies.view import IMAGE_HEIGHT, IMAGE_WIDTH, PolicyView
from advnerf_core.strict import StrictModel

_STEERING_WORDS = ("steer", "angle", "curvature")
_WAYPOINT_WORDS = ("waypoint", "traj", "plan")
_COLOURS = (3, 1)
# Inputs and outputs of the same shape are a memory if they have this length; shorter ones may be a goal and the steering.
_LONG = 8
# Planned waypoints of cars are most often half a second apart.
_WAYPOINTS_S = 0.5


@dataclass(frozen=True)
class Question:
    """A fact that a file does not contain.

    Attributes:
        key: Key of the declaration, with dots for a section's.
        choices: Possible answers; empty for a number or a section.
    """

    key: str
    text: str
    choices: tuple[str, ...] = ()


def guess_contract(path: str | Path) -> tuple[PolicyContract, list[Question]]:
    """The declaration of a policy file: its own, else one inferred from its inputs and outputs, with the usual values for the rest.

    Returns:
        The declaration, and questions about facts that the file lacks; none for a file with a declaration.

    Raises:
        PolicyContractError: The file is not a policy, or no input can be an image.
    """
    path = Path(path)
    if path.suffix == ".safetensors":
        from advnerf_core.policies.policy_file import described_file

        settings, view, _ = described_file(path)
        return PolicyContract(view, goal_size=settings["goal_size"]), []
    inputs, outputs, embedded = tensors_of(path)
    declared = find_declaration(path, embedded, inputs)
    return (declared, []) if declared is not None else _guessed(path, inputs, outputs)


def tensors_of(path: Path) -> tuple[list[TensorInfo], list[TensorInfo], str | None]:
    """Inputs and outputs of an ``.onnx`` or ``.pt2`` file, and its embedded declaration; empty without one.

    Raises:
        PolicyContractError: The file is of another kind, or cannot be read.
    """
    if path.suffix == ".onnx":
        from advnerf_core.policies.onnx_policy import opened_onnx, read_tensors

        return read_tensors(opened_onnx(path)[0])
    if path.suffix == ".pt2":
        from advnerf_core.policies.exported_policy import opened_program, program_tensors

        program, _, embedded = opened_program(path)
        return *program_tensors(program), embedded
    raise PolicyContractError(wrong_policy(path))


def _guessed(
    path: Path, inputs: list[TensorInfo], outputs: list[TensorInfo]
) -> tuple[PolicyContract, list[Question]]:
    image = _image(path, inputs)
    found, questions = _of_image(image, _value_max(path, image))
    others = [each for each in inputs if each is not image]
    states = _states(others, outputs)
    carried = {name for state in states for name in (state.input, state.output)}
    others = [each for each in others if each.name not in carried]
    if len(others) > 1 or not all(each.may_have_rank(2) for each in others):
        raise PolicyContractError(
            f"{path}: expected images, at most one goal [B, N], and states with an output of the same shape, got the inputs "
            f"{', '.join(map(str, inputs))}; write a factory for it (docs/policies.md)"
        )
    if states:
        found["states"] = states
        pairs = ", ".join(f"{each.output} to {each.input}" for each in states)
        questions.append(
            Question("states", f"Is this its memory, {pairs}, and is it 0 before the first image?")
        )
    if others:
        found |= {"goal_size": _last(others[0]) or 1, "input_name": image.name}
        questions.append(Question("goal_size", f"Is the input {others[0]} a goal, and how long is it?"))
    free = [each for each in outputs if each.name not in carried]
    meant, more = _of_output(free)
    return PolicyContract(**found, **meant), questions + more


def _image(path: Path, inputs: list[TensorInfo]) -> TensorInfo:
    fitting = [
        each
        for each in inputs
        if each.kind in (*FLOATS, UINT8) and (each.shape is None or len(each.shape) in (4, 5))
    ]
    # The largest of several, such as an image beside a state of a convolution.
    sized = sorted(fitting, key=lambda each: -sum(s for s in each.shape or () if isinstance(s, int)))
    if not sized:
        raise PolicyContractError(
            f"{path}: expected an input of images [B, 3, H, W] or [B, H, W, 3], got {', '.join(map(str, inputs)) or 'no inputs'}; export the "
            "network from its image input"
        )
    return sized[0]


def _value_max(path: Path, image: TensorInfo) -> float | None:
    """White in the images, if the file determines it; else None."""
    if image.kind == UINT8:
        return 255.0
    if path.suffix != ".onnx" or find_spec("onnx") is None:  # ONNX Runtime reads files without it
        return None
    from advnerf_core.policies.graph_range import value_max_of

    return value_max_of(path, image.name)


def _of_image(image: TensorInfo, value_max: float | None) -> tuple[dict[str, Any], list[Question]]:
    """Keys inferred from the shape, type and range of the image input, and open questions."""
    shape, questions = list(image.shape or (None,) * 4)[1:], []
    times = shape.pop(0) if len(shape) == 4 else None
    layout, channels = _layout(shape)
    rows, columns = shape[-2:] if layout == "NCHW" else shape[:2]
    height = rows if isinstance(rows, int) else IMAGE_HEIGHT
    width = columns if isinstance(columns, int) else IMAGE_WIDTH
    # Guess a lens of 90 degrees; the camera of the place replaces it.
    camera = Pinhole(width, height, 0.5 * width, 0.5 * width, 0.5 * width, 0.5 * height)
    view = PolicyView(camera, crop_top_px=0, crop_height_px=height, width=width, height=height)
    found: dict[str, Any] = {"view": view, "layout": layout}
    size = "" if (height, width) == (rows, columns) else f" and in which size (not fixed in {image})"
    text = f"For which camera is it (the lens is a guess), and which part of its picture does it see{size}?"
    questions.append(Question("view", text))
    colours, count = _stack(channels, times)
    if count is not None:
        found["frames"] = FrameStack(count=count, axis="channels" if times is None else "time")
        text = f"{image} takes {count} images: how many ticks apart, in which order, and what stands for those before the first?"
        questions.append(Question("frames", text))
    if colours == 1:
        found["colour_space"] = "GRAY"
    else:
        questions.append(Question("colour_space", "In which order are the colours?", ("RGB", "BGR", "YUV")))
    if value_max is not None:
        found["value_max"] = value_max
    else:
        text = "Which values do black and white have? Give value_max 1 or 255, and mean and std if they are used."
        questions.append(Question("value_max", text, ("1", "255")))
    return found, questions


def _layout(shape: list[Any]) -> tuple[Any, int]:
    """Layout and number of channels of an image of three axes."""
    for layout, number in (("NCHW", shape[0]), ("NHWC", shape[-1])):
        if number in _COLOURS:
            return layout, number
    fixed = [each for each in (shape[0], shape[-1]) if isinstance(each, int)]
    channels = min(fixed, default=3)
    return ("NCHW" if shape[0] == channels or not fixed else "NHWC"), channels


def _stack(channels: int, times: Any) -> tuple[int, int | None]:
    """Colours of each image, and number of images in the input; None for one."""
    if times is not None:
        return channels, times if isinstance(times, int) else 2
    if channels in _COLOURS:
        return channels, None
    return (3, channels // 3) if channels % 3 == 0 else (1, channels)


def _states(inputs: list[TensorInfo], outputs: list[TensorInfo]) -> tuple[NetworkState, ...]:
    """Inputs that share an output's name or, if they are long, its shape, in the order of the file."""
    states: list[NetworkState] = []
    left = [each for each in outputs if not _steers(each)]
    for given in inputs:
        fitting = [each for each in left if _alike(each, given) and given.kind in FLOATS]
        namesakes = [each for each in fitting if given.name.removesuffix("_in") in each.name]
        chosen = next(iter(namesakes or fitting), None)
        # One output remains, which steers.
        if (
            chosen is not None
            and len(outputs) - len(states) > 1
            and (namesakes or (_last(given) or 0) >= _LONG)
        ):
            left.remove(chosen)
            states.append(NetworkState(input=given.name, output=chosen.name, batch_axis=_batch_axis(given)))
    return tuple(states)


def _alike(output: TensorInfo, given: TensorInfo) -> bool:
    """Whether an output can feed an input: variable dimensions fit any."""
    if output.shape is None or given.shape is None or len(output.shape) != len(given.shape):
        return False
    pairs = zip(output.shape, given.shape, strict=True)
    return all(has == wants or not (isinstance(has, int) and isinstance(wants, int)) for has, wants in pairs)


def _batch_axis(tensor: TensorInfo) -> int:
    """Axis of the batch: the variable one, else the first of two and the second of three axes, as in PyTorch's states."""
    shape = tensor.shape or ()
    free = [axis for axis, size in enumerate(shape) if not isinstance(size, int)]
    return free[0] if free else min(1, max(0, len(shape) - 2))


def _of_output(outputs: list[TensorInfo]) -> tuple[dict[str, Any], list[Question]]:
    """Keys inferred from the outputs, and open questions."""
    named = [each for each in outputs if _steers(each)]
    planned = [each for each in outputs if _waypoints(each)]
    chosen = (named or planned or outputs)[0]
    found: dict[str, Any] = {"output_name": chosen.name} if len(outputs) > 1 else {}
    questions = []
    if len(outputs) > 1 and len(named or planned) != 1:
        names = tuple(each.name for each in outputs)
        questions.append(Question("output_name", "Which output steers?", names))
    side = Question("positive", "To which side does a positive output steer?", ("left", "right"))
    if chosen in planned:
        times = tuple(_WAYPOINTS_S * number for number in range(1, _waypoints(chosen) + 1))
        found["trajectory"] = TrackedTrajectory(times_s=times, lookahead_m=1.0, wheelbase_m=1.0)
        text = f"At which times are the waypoints of {chosen}, and which lookahead distance, and wheelbase or car_speed_mps, has the tracker?"
        return found, [*questions, Question("trajectory", text), side]
    columns = _last(chosen) if chosen.shape is not None and len(chosen.shape) == 2 else None
    if columns is not None and columns > 1:
        found["output_column"] = 0
        text = f"{chosen} has {columns} columns: which one steers? Or declare bins, if each is the score of a steering value."
        questions.append(Question("output_column", text, tuple(map(str, range(columns)))))
    text = "In which unit does it steer? normalised needs full_steering_rad, 1/m needs wheelbase_m."
    return found, [*questions, Question("output_unit", text, ("rad", "deg", "normalised", "1/m")), side]


def _steers(tensor: TensorInfo) -> bool:
    """Whether an output's name says that it steers."""
    return any(word in tensor.name.lower() for word in _STEERING_WORDS)


def _waypoints(tensor: TensorInfo) -> int:
    """Number of waypoints in an output; 0 if it has none."""
    shape = tensor.shape or ()
    if len(shape) == 3 and all(isinstance(each, int) for each in shape[1:]) and shape[2] in (2, 3):
        return int(shape[1] or 0)
    flat = _last(tensor) or 0
    named = any(word in tensor.name.lower() for word in _WAYPOINT_WORDS)
    return flat // 2 if len(shape) == 2 and named and flat >= 4 and flat % 2 == 0 else 0


def _last(tensor: TensorInfo) -> int | None:
    """Last dimension of a tensor; None if it is not fixed."""
    size = (tensor.shape or (None,))[-1]
    return size if isinstance(size, int) else None


def declaration_text(contract: PolicyContract, questions: Sequence[Question]) -> str:
    """A declaration as YAML for a file beside the policy: non-default values, and answers with their question above."""
    plain, default = contract.to_dict(), PolicyContract(contract.view).to_dict()
    asked = {each.key: each for each in questions}
    lines = []
    for name in dict.fromkeys(("view", *plain)):
        if name not in asked and (name == "stateless" or plain[name] == default.get(name)):
            continue  # determined by states, or the default
        if question := asked.get(name):
            choices = f" ({' or '.join(question.choices)})" if question.choices else ""
            lines.append(f"# {question.text}{choices}")
        lines.append(f"{name}: {json.dumps(_whole(getattr(contract, name), plain[name]))}")
    return "\n".join([*lines, ""])


def _whole(value: Any, plain: Any) -> Any:
    """A section with its defaults, which can then be seen and changed."""
    if isinstance(value, tuple) and value and isinstance(value[0], StrictModel):
        return [each.model_dump(mode="json") for each in value]
    return value.model_dump(mode="json") if isinstance(value, StrictModel) else plain
