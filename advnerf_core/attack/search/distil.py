"""A student of a policy that can only be queried: a network trained on its answers, which provides the gradient that the policy hides.

An attack needs the student's *slope* with respect to colours, not only its steering. Therefore every example is a pair: one place seen
with two textures, and the student is charged for the error of the difference too. That is Sobolev training (Czarnecki et al. 2017,
"Sobolev Training for Neural Networks") with finite differences instead of derivatives, which cannot be queried.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from advnerf_core.adam import Adam
from advnerf_core.policies.architecture import Architecture
from advnerf_core.policies.network import SteeringNetwork
from advnerf_core.policies.view import IMAGE_HEIGHT, IMAGE_WIDTH

StudentFactory = Callable[[tuple[int, ...], int, float], nn.Module]
"""``(image shape [3, H, W], goal size, bound of the steering [rad]) -> network(images, goals)``."""

_LEAST_BOUND_RAD = 0.1


@dataclass(frozen=True)
class Distillation:
    """Training settings of a student.

    Attributes:
        warm_pairs: Pairs of the first lesson, at random places around the first drive in random textures.
        warm_passes: Passes over the first lesson.
        fresh_pairs: Pairs that each later drive adds, at most.
        steps: Optimiser steps after each drive, at most; never more than two passes over all lessons.
        memory_pairs: Largest number of stored pairs; fresh ones then replace others at random.
        batch_pairs: Pairs of one step.
        difference_weight: Weight of the squared error of a pair's difference, relative to the errors of its two values.
        place_sigma: Spread of the random places around the first drive [m and rad].
        texture_sigma: Spread of the random textures' theta.
    """

    warm_pairs: int = 300
    warm_passes: int = 20
    fresh_pairs: int = 96
    steps: int = 10
    memory_pairs: int = 768
    batch_pairs: int = 24
    learning_rate: float = 1e-3
    difference_weight: float = 5.0
    place_sigma: float = 0.1
    texture_sigma: float = 2.0

    def __post_init__(self) -> None:
        counts = (
            self.warm_pairs,
            self.warm_passes,
            self.fresh_pairs,
            self.steps,
            self.memory_pairs,
            self.batch_pairs,
        )
        if (
            min(counts) < 1
            or self.learning_rate <= 0.0
            or self.difference_weight < 0.0
            or self.place_sigma < 0.0
        ):
            raise ValueError(
                f"expected counts >= 1, a learning rate > 0 and no negative weight or spread, got {self}"
            )


class Resized(nn.Module):
    """A network of 200 x 66 pixels for images of any size."""

    def __init__(self, network: SteeringNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor, goals: Tensor | None = None) -> Tensor:
        """Steering ``[B]`` [rad] of images ``[B, 3, H, W]``."""
        size = (IMAGE_HEIGHT, IMAGE_WIDTH)
        if tuple(images.shape[2:]) != size:
            images = nn.functional.interpolate(images, size, mode="bilinear", antialias=True)
        steering: Tensor = self.network(images, goals)
        return steering


@dataclass(frozen=True)
class ArchitectureStudent:
    """Makes students of an architecture; by default an unknown victim is assumed to resemble the usual policies of this field."""

    architecture: Architecture = field(default_factory=Architecture)

    @property
    def name(self) -> str:
        """Name that must be the same when a search is resumed; state files of interrupted searches have that of the default."""
        if self == ArchitectureStudent():
            return "pilotnet_student"
        return json.dumps(self.architecture.described(), sort_keys=True)

    def __call__(self, image_shape: tuple[int, ...], goal_size: int, bound_rad: float) -> nn.Module:
        """A network for images of any size ``[3, H, W]``."""
        del image_shape
        return Resized(self.architecture.build(goal_size, bound_rad))


@dataclass
class Lessons:
    """Pairs of images with the victim's answers.

    Attributes:
        images: ``[N, 2, 3, H, W]`` in 0..255.
        goals: ``[N, goal_size]``.
        answers: ``[N, 2]`` [rad].
    """

    images: Tensor
    goals: Tensor
    answers: Tensor

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.answers)

    def add(self, other: Lessons, capacity: int, generator: torch.Generator) -> None:
        """Add pairs; when there is no room, each replaces another at random."""
        free = min(max(0, capacity - len(self)), len(other))
        if len(other) > free:
            taken = torch.randperm(len(self), generator=generator)[: len(other) - free]
            count = len(taken)
            for mine, new in zip(self._parts(), other._parts(), strict=True):
                mine[taken] = new[free : free + count]
        if free:
            self.images = torch.cat([self.images, other.images[:free]])
            self.goals = torch.cat([self.goals, other.goals[:free]])
            self.answers = torch.cat([self.answers, other.answers[:free]])

    def _parts(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.images, self.goals, self.answers


def to_bytes(images: Tensor) -> Tensor:
    """Images 0..1 in their stored form."""
    return (images * 255.0).round().clamp(0, 255).to(torch.uint8).cpu()


class Student:
    """A network, its optimiser and its lessons; its whole state is in tensors.

    Args:
        bound_rad: Bound of its steering [rad]; twice the greatest answer of the first lessons if None.

    Attributes:
        network: The network, in eval mode except while it learns.
    """

    stateless = True
    differentiable = True
    training = False

    def __init__(
        self,
        lessons: Lessons,
        settings: Distillation,
        seed: int,
        factory: StudentFactory,
        bound_rad: float | None = None,
    ) -> None:
        self.lessons, self.settings = lessons, settings
        self.bound_rad = bound_rad or max(_LEAST_BOUND_RAD, 2.0 * float(lessons.answers.abs().max()))
        self.goal_size = lessons.goals.shape[1]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = factory(tuple(lessons.images.shape[2:]), self.goal_size, self.bound_rad).eval()
        self._names = [name for name, _ in self.network.named_parameters()]
        self._dtype = next(self.network.parameters()).dtype
        self._adam = Adam(dict(self.network.named_parameters()))

    def __call__(self, images: Tensor, goals: Tensor | None = None) -> Tensor:
        """Steering ``[B]`` [rad] of images on any device; differentiable with respect to them."""
        given = None if self.goal_size == 0 or goals is None else goals.to(self._dtype)
        steering: Tensor = self.network(images.cpu().to(self._dtype), given)
        return steering

    def begin(self, generator: torch.Generator) -> float:
        """The first lesson; see `learn`."""
        passes = self.settings.warm_passes
        return self.learn(math.ceil(passes * len(self.lessons) / self._batch), generator)

    def go_on(self, generator: torch.Generator) -> float:
        """Learn after a drive; see `learn`."""
        return self.learn(min(self.settings.steps, math.ceil(2 * len(self.lessons) / self._batch)), generator)

    @property
    def _batch(self) -> int:
        return min(self.settings.batch_pairs, len(self.lessons))

    def learn(self, steps: int, generator: torch.Generator) -> float:
        """Run optimiser steps; returns the root mean square error of their last quarter [rad]."""
        errors = []
        self.network.train().requires_grad_(True)
        for _ in range(steps):
            chosen = torch.randint(len(self.lessons), (self._batch,), generator=generator)
            images = self.lessons.images[chosen].flatten(0, 1).to(self._dtype) / 255.0
            goals = self.lessons.goals[chosen].repeat_interleave(2, dim=0)
            error = self(images, goals).reshape(-1, 2) - self.lessons.answers[chosen].to(self._dtype)
            square = (error**2).mean()
            apart = ((error[:, 0] - error[:, 1]) ** 2).mean()
            (square + self.settings.difference_weight * apart).backward()
            self._adam.step(self.settings.learning_rate)
            errors.append(float(square.detach()))
        self.network.eval().requires_grad_(False)
        last = errors[-max(1, len(errors) // 4) :]
        return float((sum(last) / len(last)) ** 0.5)

    def tensors(self) -> dict[str, Tensor]:
        """Weights, buffers, moments and lessons."""
        kept = {"images": self.lessons.images, "goals": self.lessons.goals, "answers": self.lessons.answers}
        kept["bound_rad"] = torch.tensor(self.bound_rad, dtype=torch.float64)
        for name, value in self.network.named_parameters():
            kept[f"weight.{name}"] = value.detach().clone()
            for key, moment in self._adam.moments[name].items():
                kept[f"{key}.{name}"] = moment.clone()
        for name, buffer in self.network.named_buffers():
            kept[f"buffer.{name}"] = buffer.detach().clone()
        return {f"student.{key}": value.contiguous() for key, value in kept.items()}

    @classmethod
    def from_tensors(
        cls, tensors: dict[str, Tensor], settings: Distillation, factory: StudentFactory
    ) -> Student:
        """Restore a student from its `tensors`."""
        kept = {
            key.removeprefix("student."): value
            for key, value in tensors.items()
            if key.startswith("student.")
        }
        lessons = Lessons(kept["images"], kept["goals"], kept["answers"])
        student = cls(lessons, settings, 0, factory, float(kept["bound_rad"]))
        weights, moments = dict(student.network.named_parameters()), {}
        for name, value in weights.items():
            with torch.no_grad():
                value.copy_(kept[f"weight.{name}"])
            moments[name] = {key: kept[f"{key}.{name}"] for key in ("step", "exp_avg", "exp_avg_sq")}
        for name, buffer in student.network.named_buffers():
            buffer.copy_(kept[f"buffer.{name}"])
        student._adam = Adam(weights, moments)
        student.network.requires_grad_(False)
        return student
