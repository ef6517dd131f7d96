"""What a policy says about itself, and the two conversions that follow from it. No torch here: the car's computer needs none.

Everything downstream sees one contract: images ``[B, 3, H, W]`` RGB in 0..1 in, steering ``[B]`` in radians, positive to the
left, out. A network that was trained otherwise declares how; the declaration is all that is needed to use it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import pi
from numbers import Real
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from advnerf_core.documents import parse_json, read_yaml
from advnerf_core.errors import AdvnerfError, ConfigError
from advnerf_core.policies.view import PolicyView

ColourSpace = Literal["RGB", "BGR", "YUV", "GRAY"]
Unit = Literal["rad", "deg", "normalised", "1/m"]
Side = Literal["left", "right"]
Layout = Literal["NCHW", "NHWC"]
_CHOICES: dict[str, tuple[str, ...]] = {
    "colour_space": get_args(ColourSpace), "output_unit": get_args(Unit), "positive": get_args(Side),
    "layout": get_args(Layout),
}  # fmt: skip
# Keys for files with more than one reading. Without them, declarations have the text, and policies the hash, that they always had.
_NAMED = ("input_name", "output_name", "output_column")
RAD_PER_DEG = pi / 180.0
# Full-range YUV of BT.601 with U and V about one half, and grey, both as OpenCV's COLOR_RGB2YUV and COLOR_RGB2GRAY.
_LUMA = (0.299, 0.587, 0.114)
_RGB_IN_YUV = (
    (0.299, -0.492 * 0.299, 0.877 * 0.701),
    (0.587, -0.492 * 0.587, -0.877 * 0.587),
    (0.114, 0.492 * 0.886, -0.877 * 0.114),
)


# Where an ONNX file carries its declaration.
ONNX_METADATA_KEY = "advnerf_policy"
# What a declaration beside a file adds to the file's name.
DECLARATION_SUFFIX = ".policy.yaml"


class PolicyContractError(AdvnerfError, ValueError):
    """A policy is not what its declaration says, or the declaration itself is wrong."""


@dataclass(frozen=True)
class PolicyContract:
    """The declaration of a policy.

    The network is given ``(value_max * image - mean) / std``, with the values of the image in ``colour_space`` in 0..1.

    Attributes:
        view: What the policy sees of the camera image, and its input size (``view.height``, ``view.width``).
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
        steering_ratio: Turn of the steering wheel over that of the front wheels, for an output that is the steering wheel's.
        input_name: The file's input that takes the images; None where its shapes allow one reading only.
        output_name: The file's output that steers; None where it has one output.
        output_column: The column of an output ``[B, N]`` that steers; None for ``[B]`` and ``[B, 1]``.
        positive: To which side a positive output steers.
        stateless: Whether the output depends on the present image and goal only.
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

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise PolicyContractError(
                    f"{name}: expected {' or '.join(choices)}, got {getattr(self, name)!r}"
                )
        self._check_types()
        self._check_input()
        self._check_output()
        if not isinstance(self.goal_size, int) or isinstance(self.goal_size, bool) or self.goal_size < 0:
            raise PolicyContractError(f"expected a goal size >= 0, got {self.goal_size!r}")

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
        column = self.output_column
        if column is not None and (type(column) is not int or column < 0):
            raise PolicyContractError(f"output_column: expected a whole number >= 0, got {column!r}")
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
        if self.output_unit in ("normalised", "1/m") and self.steering_ratio != 1.0:
            raise PolicyContractError(
                f"steering_ratio: expected it with output_unit = 'rad' or 'deg' only, got {self.output_unit!r}"
            )

    @property
    def channels(self) -> int:
        """Channels of the network's input."""
        return 1 if self.colour_space == "GRAY" else 3

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the images [px]."""
        return self.view.height, self.view.width

    def to_network(self, images: Any) -> Any:
        """What the network is given for images ``[B, 3, H, W]`` RGB 0..1 (numpy or torch; differentiable)."""
        if images.ndim != 4 or tuple(images.shape[1:]) != (3, *self.size):
            expected = f"[B, 3, {self.size[0]}, {self.size[1]}]"
            raise PolicyContractError(
                f"expected images {expected}, got {list(images.shape)}; use the policy's own view"
            )
        images = self._in_colour_space(images)
        if self.value_max != 1.0:
            images = images * self.value_max
        if any(self.mean):
            images = images - _channels(images, self.mean)
        if any(value != 1.0 for value in self.std):
            images = images / _channels(images, self.std)
        if self.layout == "NHWC":
            images = (
                images.permute(0, 2, 3, 1) if hasattr(images, "permute") else images.transpose(0, 2, 3, 1)
            )
        return images

    def _in_colour_space(self, images: Any) -> Any:
        if self.colour_space == "RGB":
            return images
        if self.colour_space == "BGR":
            return images[:, [2, 1, 0]]
        if self.colour_space == "GRAY":
            return _LUMA[0] * images[:, 0:1] + _LUMA[1] * images[:, 1:2] + _LUMA[2] * images[:, 2:3]
        # One colour at a time, each copied into three channels: the same code for numpy and torch.
        parts = [images[:, [k] * 3] * _channels(images, weights) for k, weights in enumerate(_RGB_IN_YUV)]
        return (parts[0] + parts[1] + parts[2] + _channels(images, (0.0, 0.5, 0.5))).clip(0.0, 1.0)

    def to_steering_rad(self, raw: Any, batch: int) -> Any:
        """Steering ``[B]`` [rad], left positive, of the network's output ``[B]``, ``[B, 1]`` or ``[B, N]`` (numpy or torch)."""
        raw = self._steering_column(raw, batch)
        side = 1.0 if self.positive == "left" else -1.0
        if self.output_unit == "1/m":
            bend = raw * (side * float(self.wheelbase_m or 0.0))
            return bend.atan() if hasattr(bend, "atan") else np.arctan(bend)
        unit = {"rad": 1.0, "deg": RAD_PER_DEG, "normalised": self.full_steering_rad or 0.0}[self.output_unit]
        scale = side * unit / self.steering_ratio
        return raw if scale == 1.0 else raw * scale

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

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which `from_dict` makes the same declaration; names that are not declared are left out."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        values = {name: value for name, value in values.items() if value is not None or name not in _NAMED}
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


def declaration_beside(path: Path, embedded: str | None, **implied: Any) -> PolicyContract:
    """The declaration of a file: the YAML file ``<path>.policy.yaml`` if there is one, else what the file carries.

    Args:
        embedded: JSON that the file carries; None or empty if it carries none.
        **implied: What the file itself says about keys that the declaration leaves out.
    """
    beside = path.with_name(path.name + DECLARATION_SUFFIX)
    try:
        if beside.is_file():
            return PolicyContract.from_dict(read_yaml(beside).data, str(beside), **implied)
        if embedded:
            return PolicyContract.from_dict(parse_json(embedded, str(path)), str(path), **implied)
    except PolicyContractError:
        raise
    except ConfigError as error:
        raise PolicyContractError(f"cannot read the declaration of {path}: {error}") from error
    raise PolicyContractError(
        f"{path} says nothing about its colours, range and unit; write {beside.name} beside it (see docs/policies.md)"
    )


def _channels(images: Any, values: tuple[float, ...]) -> Any:
    if hasattr(images, "new_tensor"):
        return images.new_tensor(values).view(1, -1, 1, 1)
    return np.asarray(values, dtype=images.dtype).reshape(1, -1, 1, 1)
