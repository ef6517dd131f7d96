"""The interface of a policy, and the base class of the networks that this project trains."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from advnerf_core.policies.view import IMAGE_HEIGHT, IMAGE_WIDTH

# Weights of the few goal inputs, beside a thousand features, start larger by this factor; otherwise a policy learns every view before
# it learns to use the goal, which only the views ahead of a junction need.
_GOAL_GAIN = 12.0


class Policy(Protocol):
    """The interface of a policy for rollouts and attacks."""

    stateless: bool

    def __call__(self, images: Tensor, goals: Tensor | None = None) -> Tensor:
        """Steering ``[B]`` [rad], left positive, for images ``[B, 3, H, W]`` RGB 0..1 and goals ``[B, goal_size]``."""


class SteeringNetwork(nn.Module):
    """Base of all architectures. A subclass implements `output`; this class checks the inputs and bounds the steering.

    The attack differentiates the steering in the images, so `output` must be differentiable. The trainer puts the network into train
    mode, and everything else into eval mode.

    Args:
        goal_size: Length of the goal vector, 0 for none.
        max_steering_rad: Bound of the steering [rad].
        configuration: An instance of `Configuration`; None for its defaults.

    Attributes:
        Configuration: Dataclass or pydantic model of the architecture's own settings, all with defaults and of values that JSON can hold;
            None if it has no settings.
        stateless: True: the steering depends on the current image and goal only.
        rows_independent: Whether the steering of an image depends on nothing else in its batch and on no random draw, in train mode,
            too. Training then splits batches between threads, and runs the layers in bfloat16 where the machine has it.
        reference: Name of the architecture, or ``file.py:Class`` with an absolute path; empty if the class was called directly.
        code_sha256: Hash of the code behind a user's architecture, when it was loaded; empty for a built-in one.
        code_files: Python files of ``file.py:Class`` when it was loaded: the file, and the modules beside it that it imports.
    """

    Configuration: ClassVar[type[Any] | None] = None
    stateless = True
    rows_independent: ClassVar[bool] = False

    def __init__(self, goal_size: int = 0, max_steering_rad: float = 0.30, configuration: Any = None) -> None:
        super().__init__()
        if goal_size < 0 or not max_steering_rad > 0.0:
            raise ValueError(
                f"expected goal_size >= 0 and max_steering_rad > 0, got {goal_size}, {max_steering_rad}"
            )
        self.goal_size = goal_size
        self.max_steering_rad = max_steering_rad
        if configuration is None and self.Configuration is not None:
            configuration = self.Configuration()
        self.configuration = configuration
        self.reference = self.code_sha256 = ""
        self.code_files: dict[str, bytes] = {}

    def output(self, images: Tensor, goals: Tensor | None) -> Tensor:
        """Unbounded output ``[B]``, left positive.

        Args:
            images: ``[B, 3, 66, 200]`` RGB in 0..1, float32 or float64 like the weights.
            goals: ``[B, goal_size]`` in the type of the images; None if ``goal_size`` is 0.
        """
        raise NotImplementedError(f"{type(self).__name__} has no output(); implement it")

    def forward(self, images: Tensor, goals: Tensor | None = None) -> Tensor:
        """Steering ``[B]`` [rad], left positive, within ``+-max_steering_rad``.

        Args:
            images: ``[B, 3, 66, 200]`` RGB in 0..1, float32 or float64 like the weights.
            goals: ``[B, goal_size]``; must be given exactly if ``goal_size > 0``.
        """
        if images.ndim != 4 or images.shape[1:] != (3, IMAGE_HEIGHT, IMAGE_WIDTH):
            raise ValueError(
                f"expected images [B, 3, {IMAGE_HEIGHT}, {IMAGE_WIDTH}], got {list(images.shape)}"
            )
        if self.goal_size > 0 or goals is not None:
            shape = None if goals is None else list(goals.shape)
            if goals is None or shape != [images.shape[0], self.goal_size]:
                raise ValueError(f"expected goals [{images.shape[0]}, {self.goal_size}], got {shape}")
            goals = goals.to(images.dtype)
        output = self.output(images, goals)
        if output.ndim != 1:
            raise ValueError(f"expected an output [B], got {list(output.shape)}")
        steering: Tensor = self.max_steering_rad * torch.tanh(output)
        return steering


class FeaturesAndHead(SteeringNetwork):
    """An architecture of ``features``, which become one row per image, and a linear ``head`` that the goal joins."""

    features: nn.Module
    head: nn.Module

    def output(self, images: Tensor, goals: Tensor | None) -> Tensor:
        """Unbounded output ``[B]`` of images ``[B, 3, 66, 200]`` in 0..1 and goals ``[B, goal_size]``; colours are scaled to [-1, 1]."""
        features = self.features(images * 2.0 - 1.0)
        if goals is not None:
            features = torch.cat([features, goals], dim=1)
        output: Tensor = self.head(features)[:, 0]
        return output

    def raise_goal_weights(self, feature_count: int) -> None:
        """Start with larger weights of the goals, which come after the features in the first layer of ``head``."""
        if self.goal_size:
            with torch.no_grad():  # loaded weights and policies without a goal are not changed by this
                next(self.head.parameters())[:, feature_count:] *= _GOAL_GAIN


def images_to_tensor(images: NDArray[np.uint8]) -> Tensor:
    """Tensor ``[B, 3, H, W]`` RGB 0..1 from uint8 images ``[B, H, W, 3]`` (or one image ``[H, W, 3]``)."""
    batch = np.ascontiguousarray(images if images.ndim == 4 else images[None])
    if not batch.flags.writeable:
        batch = batch.copy()  # torch warns about read-only buffers
    # The memory stays channels-last, which is also the faster layout for the convolutions.
    return torch.from_numpy(batch).permute(0, 3, 1, 2).to(torch.float32).div(255.0)


def tensor_to_images(images: Tensor) -> NDArray[np.uint8]:
    """Images ``[B, H, W, 3]`` uint8 of a tensor ``[B, 3, H, W]`` RGB 0..1."""
    # NumPy: torch would wake its threads for each of these small steps.
    levels = np.clip(images.detach().numpy(), 0.0, 1.0) * np.float32(255.0)
    return np.ascontiguousarray(np.rint(levels, out=levels).astype(np.uint8).transpose(0, 2, 3, 1))
