"""The declaration of a policy, and the two conversions that follow from it. No torch here: the car's computer needs none.

All other code uses one contract: images ``[B, 3, H, W]`` RGB in 0..1 in, steering ``[B]`` in radians, positive to the
left, out. A network that was trained otherwise declares how; the declaration is all that is needed to use it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from math import pi
from numbers import Real
from typing import Any, Literal, get_args

import numpy as np

from advnerf_core.documents import Document
from advnerf_core.errors import AdvnerfError, ConfigError
from advnerf_core.policies.arrays import array_module, like
from advnerf_core.policies.bins import SteeringBins
from advnerf_core.policies.colours import ColourSpace, in_colour_space, of_channels
from advnerf_core.policies.frames import FrameStack
from advnerf_core.policies.memory import NetworkState
from advnerf_core.policies.tracker import TrackedTrajectory
from advnerf_core.policies.view import PolicyView
from advnerf_core.strict import parse_value

Unit = Literal["rad", "deg", "normalised", "1/m"]
Side = Literal["left", "right"]
Layout = Literal["NCHW", "NHWC"]
_CHOICES: dict[str, tuple[str, ...]] = {
    "colour_space": get_args(ColourSpace), "output_unit": get_args(Unit), "positive": get_args(Side),
    "layout": get_args(Layout),
}  # fmt: skip
_SECTIONS: dict[str, Any] = {
    "frames": FrameStack, "trajectory": TrackedTrajectory, "bins": SteeringBins, "states": tuple[NetworkState, ...],
}  # fmt: skip
# Keys that came later. Without them, declarations keep their text, and policies their hash.
_LATER = ("input_name", "output_name", "output_index", "output_column", *_SECTIONS)
RAD_PER_DEG = pi / 180.0
# Above these, degrees or millimetres were meant.
_LARGEST = (
    ("full_steering_rad", 1.5, "rad (25 degrees are 0.436)"), ("wheelbase_m", 20.0, "m"), ("steering_ratio", 100.0, "to 1"),
)  # fmt: skip


class PolicyContractError(AdvnerfError, ValueError):
    """A policy contradicts its declaration, or the declaration itself is wrong."""


@dataclass(frozen=True)
class PolicyContract:
    """The declaration of a policy.

    The network gets ``(value_max * image - mean) / std``, with the values of the image in ``colour_space`` in 0..1.

    Attributes:
        view: Window of the camera image that the policy sees, and its input size (``view.height``, ``view.width``).
        colour_space: The network's input channels: ``RGB``, ``BGR``, ``YUV`` (full range, as 8-bit OpenCV makes it: U and V
            about one half and clipped to 0..1) or ``GRAY`` (one channel).
        value_max: White in the network's input before ``mean`` and ``std``: 1 or 255.
        mean: Subtracted from each channel, in the network's channel order and in units of ``value_max``; one number is for all.
        std: Divides each channel; one number is for all.
        layout: ``NCHW``, or ``NHWC`` for channels last.
        output_unit: Unit of the network's output: the angle of the front wheels in ``rad`` or ``deg``, the same
            ``normalised`` by ``full_steering_rad``, or the inverse turning radius of the rear axle in ``1/m``.
        full_steering_rad: Angle of the front wheels at a normalised output of 1 [rad]; with ``normalised`` only.
        wheelbase_m: Wheelbase that turns an inverse radius into an angle, ``atan(wheelbase / radius)`` [m]; with ``1/m`` only.
        steering_ratio: Steering wheel angle over front wheel angle, for an output of the steering wheel's angle.
        input_name: The file's input for the images; None if its shapes allow one reading only.
        output_name: The output that steers, of a file or of a network that returns a dict; None if there is one output.
        output_index: Index of that output from 0, of a file or of a network that returns a tuple.
        output_column: The column of an output ``[B, N]`` that steers; None for ``[B]`` and ``[B, 1]``.
        frames: Past images in the input. This and the next three are sections, which may be given as their keys and values.
        trajectory: The tracker of an output of waypoints; None for an output that steers.
        bins: Steering values of an output of scores; None for an output that steers.
        states: Inputs and outputs of a file that carry its memory from image to image; with them it is not stateless.
        positive: Side to which a positive output steers.
        stateless: Whether the network's output depends on its present input only; a stack of ``frames`` is such an input.
        differentiable: Whether gradients reach the image; a black box declares False.
        goal_size: Length of the goal vector; 0 for none.
    """

    view: PolicyView
    colour_space: ColourSpace = "RGB"
    value_max: float = 1.0
    mean: tuple[float, ...] = (0.0,)
    std: tuple[float, ...] = (1.0,)
    layout: Layout = "NCHW"
    output_unit: Unit = "rad"
    positive: Side = "left"
    stateless: bool = True
    differentiable: bool = True
    goal_size: int = 0
    full_steering_rad: float | None = None
    wheelbase_m: float | None = None
    steering_ratio: float = 1.0
    input_name: str | None = None
    output_name: str | None = None
    output_column: int | None = None
    output_index: int | None = None
    frames: FrameStack | None = None
    trajectory: TrackedTrajectory | None = None
    bins: SteeringBins | None = None
    states: tuple[NetworkState, ...] = ()

    def __post_init__(self) -> None:
        for name in ("mean", "std"):
            given: Any = getattr(self, name)  # one number, or some in any sequence
            numbers = tuple(given) if isinstance(given, Iterable) and not isinstance(given, str) else (given,)
            object.__setattr__(self, name, numbers)
        self._read_sections()
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise PolicyContractError(
                    f"{name}: expected {' or '.join(choices)}, got {getattr(self, name)!r}"
                )
        self._check_types()
        self._check_input()
        self._check_output()
        if type(self.goal_size) is not int or self.goal_size < 0:
            raise PolicyContractError(f"expected a goal size >= 0, got {self.goal_size!r}")

    def _read_sections(self) -> None:
        """Convert sections that are given as their keys and values to objects."""
        try:
            for name, kind in _SECTIONS.items():
                if (given := getattr(self, name)) not in (None, ()):
                    object.__setattr__(self, name, parse_value(kind, Document(given, name)))
        except ConfigError as error:
            raise PolicyContractError(str(error)) from error
        if self.states:
            object.__setattr__(self, "stateless", False)

    def _check_types(self) -> None:
        for name in ("value_max", "full_steering_rad", "wheelbase_m", "steering_ratio", "mean", "std"):
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                # A boolean counts as a number in Python.
                if number is not None and (isinstance(number, bool) or not isinstance(number, Real)):
                    raise PolicyContractError(f"{name}: expected a number, got {number!r}")
        for name in ("stateless", "differentiable"):
            if not isinstance(getattr(self, name), bool):
                raise PolicyContractError(f"{name}: expected true or false, got {getattr(self, name)!r}")

    def _check_input(self) -> None:
        for name in ("mean", "std"):
            if len(getattr(self, name)) not in (1, self.channels):
                raise PolicyContractError(
                    f"{name}: expected 1 number or {self.channels} (one for each channel of {self.colour_space}), "
                    f"got {len(getattr(self, name))}"
                )
        numbers = np.array([self.value_max, *self.mean, *self.std], dtype=np.float64)
        if not np.isfinite(numbers).all() or min(self.value_max, *self.std) <= 0.0:
            raise PolicyContractError(
                f"expected finite means, and value_max and std > 0, got {self.mean}, {self.value_max} and {self.std}"
            )

    def _check_output(self) -> None:
        for name in ("input_name", "output_name"):
            if not isinstance(given := getattr(self, name), str | None):
                raise PolicyContractError(f"{name}: expected text, got {given!r}; put it in quotes")
        for name in ("output_column", "output_index"):
            number = getattr(self, name)
            if number is not None and (type(number) is not int or number < 0):
                raise PolicyContractError(f"{name}: expected a whole number >= 0, got {number!r}")
        if self.output_name is not None and self.output_index is not None:
            raise PolicyContractError("expected output_name or output_index, got both; remove one")
        self._check_meaning()
        if not (np.isfinite(self.steering_ratio) and self.steering_ratio > 0.0):
            raise PolicyContractError(f"steering_ratio: expected a number > 0, got {self.steering_ratio}")
        for name, unit in (("full_steering_rad", "normalised"), ("wheelbase_m", "1/m")):
            value = getattr(self, name)
            if self.output_unit != unit and value is not None:
                raise PolicyContractError(f"{name}: expected it with output_unit = {unit!r} only; remove it")
            if self.output_unit == unit and not (value is not None and np.isfinite(value) and value > 0.0):
                raise PolicyContractError(
                    f"{name}: expected a number > 0 with output_unit = {unit!r}, got {value}"
                )
        for name, most, unit in _LARGEST:
            value = getattr(self, name)
            if value is not None and value > most:
                raise PolicyContractError(f"{name}: expected at most {most:g} {unit}, got {value:g}")
        if self.output_unit in ("normalised", "1/m") and self.steering_ratio != 1.0:
            raise PolicyContractError(
                f"steering_ratio: expected it with output_unit = 'rad' or 'deg' only, got {self.output_unit!r}"
            )

    def _check_meaning(self) -> None:
        """Check that an output is either an angle, waypoints, or scores of bins."""
        given = [name for name in ("output_column", "trajectory", "bins") if getattr(self, name) is not None]
        if len(given) > 1:
            raise PolicyContractError(
                f"expected an output of one kind, got {' and '.join(given)}; keep the one that the network has"
            )
        if self.trajectory is not None and (self.output_unit, self.steering_ratio) != ("rad", 1.0):
            raise PolicyContractError(
                "output_unit, steering_ratio: expected neither with a trajectory, which is in metres; remove them"
            )
        if self.bins is not None and self.bins.choice == "largest":  # no gradient passes through the choice
            object.__setattr__(self, "differentiable", False)

    @property
    def channels(self) -> int:
        """Channels of one image in the network's input."""
        return 1 if self.colour_space == "GRAY" else 3

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the images [px]."""
        return self.view.height, self.view.width

    @property
    def has_memory(self) -> bool:
        """Whether the steering depends on earlier images."""
        return self.frames is not None or not self.stateless

    @property
    def meaning(self) -> str:
        """Meaning of the output, as text."""
        if self.trajectory is not None:
            return f"{len(self.trajectory.times_s)} waypoints"
        if self.bins is not None:
            return f"scores of {len(self.bins.values)} steering values"
        return "steering" if self.output_column is None else f"steering, column {self.output_column}"

    @property
    def input_shape(self) -> tuple[int, ...]:
        """Shape of the network's image input without its batch."""
        count = 1 if self.frames is None else self.frames.count
        times = (count,) if self.frames is not None and self.frames.axis == "time" else ()
        channels = self.channels if times else count * self.channels
        return (*times, channels, *self.size) if self.layout == "NCHW" else (*times, *self.size, channels)

    def to_network(self, images: Any) -> Any:
        """The network's input for images (numpy or torch; differentiable).

        Args:
            images: ``[B, 3, H, W]`` RGB 0..1; with ``frames`` the stack ``[B, count, 3, H, W]``.
        """
        stack = () if self.frames is None else (self.frames.count,)
        if tuple(images.shape[1:]) != (*stack, 3, *self.size):
            expected = ", ".join(map(str, ("B", *stack, 3, *self.size)))
            raise PolicyContractError(
                f"expected images [{expected}], got {list(images.shape)}; use the policy's own view"
            )
        batch, images = len(images), images.reshape(-1, 3, *self.size)
        images = in_colour_space(
            images + 0.0, self.colour_space
        )  # a copy: a network may normalise its input in place
        if self.value_max != 1.0:
            images = images * self.value_max
        if any(self.mean):
            images = images - of_channels(images, self.mean)
        if any(value != 1.0 for value in self.std):
            images = images / of_channels(images, self.std)
        if self.frames is not None:
            count = () if self.frames.axis == "channels" else (self.frames.count,)
            images = images.reshape(batch, *count, -1, *self.size)
        return images if self.layout == "NCHW" else array_module(images).moveaxis(images, -3, -1)

    def first_input(self, images: Any) -> Any:
        """The network's input for the first images ``[B, 3, H, W]`` of a drive."""
        if self.frames is None:
            return self.to_network(images)
        past = like(images, self.frames.initial(len(images), self.size))
        return self.to_network(self.frames.push(images, past)[0])

    def to_steering_rad(self, raw: Any, batch: int) -> Any:
        """Steering ``[B]`` [rad], left positive, from the network's output (numpy or torch; differentiable).

        Args:
            raw: ``[B]``, ``[B, 1]``, or ``[B, N]`` with ``output_column`` or ``bins``; with ``trajectory`` as in `waypoints_m`.
            batch: Number of images.
        """
        if self.trajectory is not None:
            return self.trajectory.control(self.waypoints_m(raw, batch))
        if self.bins is not None:
            raw = self.bins.value(self._checked(raw, (batch, len(self.bins.values)), "bins"))
        raw = self._steering_column(raw, batch)
        side = 1.0 if self.positive == "left" else -1.0
        if self.output_unit == "1/m":
            return array_module(raw).arctan(raw * (side * float(self.wheelbase_m or 0.0)))
        unit = {"rad": 1.0, "deg": RAD_PER_DEG, "normalised": self.full_steering_rad or 0.0}[self.output_unit]
        scale = side * unit / self.steering_ratio
        return raw if scale == 1.0 else raw * scale

    def waypoints_m(self, raw: Any, batch: int) -> Any:
        """Waypoints ``[B, N, 2]`` [m], x forward and y left, from the network's output ``[B, N, 2 or more]`` or ``[B, 2 N]``."""
        assert self.trajectory is not None
        count = len(self.trajectory.times_s)
        shape = tuple(getattr(raw, "shape", ()))
        if len(shape) == 3 and shape[:2] == (batch, count) and shape[2] > 2:
            raw = raw[:, :, :2]  # values after x and y, such as a heading, are not used
        elif shape == (batch, 2 * count):
            raw = raw.reshape(batch, count, 2)
        raw = self._checked(raw, (batch, count, 2), "trajectory.times_s")
        return raw if self.positive == "left" else raw * like(raw, (1.0, -1.0))

    def _steering_column(self, raw: Any, batch: int) -> Any:
        shape, column = tuple(getattr(raw, "shape", ())), self.output_column
        if column is None and shape == (batch,):
            return raw
        if len(shape) == 2 and shape[0] == batch and (shape[1] == 1 if column is None else column < shape[1]):
            return raw[:, column or 0]
        wanted = "[B] or [B, 1]" if column is None else f"[B, N] with the column {column}"
        raise PolicyContractError(
            f"expected the network's output to be {wanted} steering angles, got {list(shape) or type(raw).__name__} "
            f"for B = {batch}; return the column that steers, or declare it as output_column"
        )

    def _checked(self, raw: Any, shape: tuple[int, ...], key: str) -> Any:
        if tuple(getattr(raw, "shape", ())) != shape:
            raise PolicyContractError(
                f"{key}: expected an output of {list(shape)}, got {list(getattr(raw, 'shape', ())) or type(raw).__name__}; correct the declaration"
            )
        return raw

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which `from_dict` rebuilds the declaration; undeclared names are left out."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        values = {
            name: _plain(value) if name in _SECTIONS else value
            for name, value in values.items()
            if value not in (None, ()) or name not in _LATER
        }
        return {**values, "view": self.view.to_dict(), "mean": list(self.mean), "std": list(self.std)}

    def to_json(self) -> str:
        """The same as canonical text."""
        return json.dumps(self.to_dict(), sort_keys=True, separators=(",", ":"), allow_nan=False)

    @classmethod
    def from_dict(cls, data: Any, source: str = "declaration", **implied: Any) -> PolicyContract:
        """Rebuild a declaration; an unknown or missing key is one error that names it.

        Args:
            data: The declaration's keys and values.
            **implied: Values of keys that the declaration leaves out.
        """
        if not isinstance(data, Mapping) or "view" not in data:
            raise PolicyContractError(f"{source}: expected keys and values with a 'view', got {data!r:.80}")
        known = [field.name for field in fields(cls)]
        if unknown := sorted(set(data) - set(known)):
            raise PolicyContractError(f"{source}: unknown key {unknown[0]}; valid keys: {', '.join(known)}")
        try:
            values = {**implied, **data, "view": PolicyView.from_dict(data["view"])}
            for name in ("mean", "std"):
                if name in values:
                    given = values[name]
                    values[name] = tuple(given) if isinstance(given, list | tuple) else (given,)
            return cls(**values)
        except (TypeError, ValueError) as error:
            raise PolicyContractError(f"{source}: {error}") from error


def _plain(value: Any) -> Any:
    """Sections of a declaration as JSON values, without their defaults."""
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return value.model_dump(mode="json", exclude_defaults=True)
