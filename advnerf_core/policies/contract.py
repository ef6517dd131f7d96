"""What a policy says about itself, and the two conversions that follow from it. No torch here: the car's computer needs none.

Everything downstream sees one contract: images ``[B, 3, H, W]`` RGB in 0..1 in, steering ``[B]`` in radians, positive to the
left, out. A network that was trained otherwise declares how; the declaration is all that is needed to use it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import pi
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import yaml

from advnerf_core.driving.policy_view import PolicyView
from advnerf_core.errors import AdvnerfError

ColourOrder = Literal["RGB", "BGR"]
Unit = Literal["rad", "deg"]
Side = Literal["left", "right"]
Layout = Literal["NCHW", "NHWC"]
_CHOICES: dict[str, tuple[str, ...]] = {
    "colour_order": get_args(ColourOrder), "output_unit": get_args(Unit), "positive": get_args(Side),
    "layout": get_args(Layout),
}  # fmt: skip
RAD_PER_DEG = pi / 180.0


class PolicyContractError(AdvnerfError, ValueError):
    """A policy is not what its declaration says, or the declaration itself is wrong."""


@dataclass(frozen=True)
class PolicyContract:
    """The declaration of a policy.

    The network is given ``(value_max * image - mean) / std`` with the image's values in 0..1.

    Attributes:
        view: What the policy sees of the camera image, and its input size (``view.height``, ``view.width``).
        colour_order: Order of the network's input channels.
        value_max: White in the network's input before ``mean`` and ``std``: 1 or 255.
        mean: Subtracted from each channel, in the network's channel order and in units of ``value_max``.
        std: Divides each channel.
        layout: ``NCHW``, or ``NHWC`` for channels last.
        output_unit: Unit of the network's output.
        positive: To which side a positive output steers.
        stateless: Whether the output depends on the present image and goal only.
        differentiable: Whether gradients reach the image; a black box declares False.
        goal_size: Length of the goal vector; 0 for none.
    """

    view: PolicyView
    colour_order: ColourOrder = "RGB"
    value_max: float = 1.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    layout: Layout = "NCHW"
    output_unit: Unit = "rad"
    positive: Side = "left"
    stateless: bool = True
    differentiable: bool = True
    goal_size: int = 0

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise PolicyContractError(f"{name}: expected {' or '.join(choices)}, got {getattr(self, name)!r}")
        numbers = np.array([self.value_max, *self.mean, *self.std], dtype=np.float64)
        whole = isinstance(self.goal_size, int) and self.goal_size >= 0
        if numbers.shape != (7,) or not np.isfinite(numbers).all() or not whole:
            raise PolicyContractError(f"expected 3 means, 3 deviations and a goal size >= 0, all finite, got {self}")
        if min(self.value_max, *self.std) <= 0.0:
            raise PolicyContractError(f"expected value_max and std > 0, got {self.value_max} and {self.std}")

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
        if self.colour_order == "BGR":
            images = images[:, [2, 1, 0]]
        if self.value_max != 1.0:
            images = images * self.value_max
        if any(self.mean):
            images = images - _channels(images, self.mean)
        if self.std != (1.0, 1.0, 1.0):
            images = images / _channels(images, self.std)
        if self.layout == "NHWC":
            images = images.permute(0, 2, 3, 1) if hasattr(images, "permute") else images.transpose(0, 2, 3, 1)
        return images

    def to_steering_rad(self, raw: Any, batch: int) -> Any:
        """Steering ``[B]`` [rad], left positive, of the network's output ``[B]`` or ``[B, 1]`` (numpy or torch)."""
        shape = tuple(getattr(raw, "shape", ()))
        if shape == (batch, 1):
            raw = raw[:, 0]
        elif shape != (batch,):
            raise PolicyContractError(
                f"expected the network's output to be [B] or [B, 1] steering angles, got {list(shape) or type(raw).__name__} "
                f"for B = {batch}; return the column that steers"
            )
        scale = (RAD_PER_DEG if self.output_unit == "deg" else 1.0) * (1.0 if self.positive == "left" else -1.0)
        return raw if scale == 1.0 else raw * scale

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which `from_dict` makes the same declaration."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**values, "view": self.view.to_dict(), "mean": list(self.mean), "std": list(self.std)}

    def to_json(self) -> str:
        """The same as canonical text."""
        return json.dumps(self.to_dict(), sort_keys=True, separators=(",", ":"), allow_nan=False)

    @classmethod
    def from_dict(cls, data: Any, source: str = "declaration") -> PolicyContract:
        """Rebuild a declaration; an unknown or missing key is one error that names it."""
        if not isinstance(data, Mapping) or "view" not in data:
            raise PolicyContractError(f"{source}: expected keys and values with a 'view', got {data!r:.80}")
        known = [field.name for field in fields(cls)]
        if unknown := sorted(set(data) - set(known)):
            raise PolicyContractError(f"{source}: unknown key {unknown[0]}; valid keys: {', '.join(known)}")
        try:
            values = {**data, "view": PolicyView.from_dict(data["view"])}
            for name in ("mean", "std"):
                if name in values:
                    values[name] = tuple(float(value) for value in values[name])
            return cls(**values)
        except (TypeError, ValueError) as error:
            raise PolicyContractError(f"{source}: {error}") from error


def declaration_beside(path: Path, embedded: str | None) -> PolicyContract:
    """The declaration of a file: the YAML file ``<path>.policy.yaml`` if there is one, else what the file carries.

    Args:
        path: The policy file.
        embedded: JSON that the file carries; None or empty if it carries none.
    """
    beside = path.with_name(path.name + ".policy.yaml")
    try:
        if beside.is_file():
            return PolicyContract.from_dict(yaml.safe_load(beside.read_text(encoding="utf-8")), str(beside))
        if embedded:
            return PolicyContract.from_dict(json.loads(embedded), str(path))
    except (yaml.YAMLError, json.JSONDecodeError) as error:
        raise PolicyContractError(f"cannot read the declaration of {path}: {' '.join(str(error).split())}") from error
    raise PolicyContractError(
        f"{path} says nothing about its colours, range and unit; write {beside.name} beside it (see docs/policies.md)"
    )


def _channels(images: Any, values: tuple[float, ...]) -> Any:
    if hasattr(images, "new_tensor"):
        return images.new_tensor(values).view(1, 3, 1, 1)
    return np.asarray(values, dtype=images.dtype).reshape(1, 3, 1, 1)
