"""Supervised training of the policy on frames: deterministic, and resumable to the bit.

Everything random in step ``t`` is drawn from a generator seeded by ``(seed, t)``, so a checkpoint needs no generator state:
weights, optimiser moments and the step number are its whole state.

Two threads each take half of a batch from its frames to its gradient, without waiting for each other. The halves are the same on any
number of cores, and their gradients are added in order. Machines of other types differ in the last bits, or in the number type.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from math import cos, isfinite, pi
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from advnerf_core.adam import Adam
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import read_tensors, write_tensors
from advnerf_core.learning.augment import AugmentConfig, Changes
from advnerf_core.learning.frames import Batch, FrameSet, FrameStoreError
from advnerf_core.memory import freed_blocks_kept
from advnerf_core.parallel import run_slots, slot_bounds
from advnerf_core.policies.network import SteeringNetwork, images_to_tensor
from advnerf_core.policies.number_type import layer_type

EVALUATION_BATCH = 128
_PARTS = 2  # of a batch: smaller ones cost more than a third and fourth core would save


class DivergedError(AdvnerfError, ArithmeticError):
    """A network's errors or weights are no longer numbers."""


@dataclass(frozen=True)
class FitConfig:
    """Settings of one training.

    Attributes:
        steps: Optimiser steps.
        learning_rate: Peak; linear warm-up, then a half cosine to a hundredth of it.
        warm_up_steps: Length of the warm-up.
        huber_rad: Errors beyond this count linearly [rad].
        checkpoint_every: Steps between checkpoints.
    """

    steps: int
    batch_size: int = 64
    learning_rate: float = 1e-3
    warm_up_steps: int = 20
    weight_decay: float = 1e-4
    huber_rad: float = 0.1
    seed: int = 0
    checkpoint_every: int = 100
    augment: AugmentConfig = field(default_factory=AugmentConfig)


def fit(
    policy: SteeringNetwork,
    frames: FrameSet,
    config: FitConfig,
    checkpoint: Path | None = None,
    report: Callable[[int, float], None] | None = None,
    number_type: torch.dtype | None = None,
) -> None:
    """Train ``policy`` in place on ``frames.training``.

    Args:
        policy: The network; its weights are the start unless the checkpoint holds a later step.
        checkpoint: File to continue from and to write every ``checkpoint_every`` steps and at the end.
        report: Called with the step and the running mean square error [rad^2].
        number_type: float32 or bfloat16, of the layers of a network with ``rows_independent``; None for the machine's
            (`layer_type`). Other networks are trained in float32.

    Raises:
        FrameStoreError: There are no frames to train on.
        DivergedError: The errors or the weights are no longer numbers; the last checkpoint is of before.
    """
    if len(frames.training) == 0:
        raise FrameStoreError(
            "expected training frames, got none: collect frames, or lower the share that is held out"
        )
    policy.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    done, moments = (0, {}) if checkpoint is None else _resume(checkpoint, policy, config)
    optimiser = Adam(dict(policy.named_parameters()), moments, config.weight_decay, fused=True)
    gradients = Gradients(policy, config, number_type or layer_type())
    policy.train()
    running = 0.0
    with freed_blocks_kept():
        for step in range(done, config.steps):
            error, found = gradients.of_step(frames, step)
            _require_number(error, f"step {step + 1} of {config.steps}", config)
            optimiser.step(_learning_rate(config, step), found)
            running = error if step == done else 0.95 * running + 0.05 * error
            finished = step + 1
            last = finished == config.steps
            if checkpoint is not None and (finished % config.checkpoint_every == 0 or last):
                _write(checkpoint, policy, optimiser, finished, config)
            if report is not None and (finished % 10 == 0 or last):
                report(finished, running)
    largest = max((float(each.detach().abs().max()) for each in policy.parameters()), default=0.0)
    _require_number(largest, "its last step", config)
    policy.eval()


def _require_number(value: float, where: str, config: FitConfig) -> None:
    if not isfinite(value):
        raise DivergedError(
            f"expected training with errors and weights that are numbers, got {value} at {where}: it diverges. Lower the learning rate of "
            f"{config.learning_rate:g}, or look for a layer whose values grow without bound"
        )


@torch.no_grad()
def mean_absolute_error(policy: SteeringNetwork, frames: FrameSet) -> float:
    """Mean absolute steering error [rad] on the held-out frames (on the training frames if none are held out)."""
    rows = frames.held_out if len(frames.held_out) else frames.training
    total = 0.0
    for start in range(0, len(rows), EVALUATION_BATCH):
        images, labels, goals = frames.batch(rows[start : start + EVALUATION_BATCH])
        output = policy(images_to_tensor(images), torch.from_numpy(goals) if policy.goal_size else None)
        total += float((output - torch.from_numpy(labels)).abs().sum())
    return total / len(rows)


class Gradients:
    """The gradients of a network's loss on the batches of a training.

    Args:
        number_type: Number type of its layers, if its rows are independent.
    """

    def __init__(self, policy: SteeringNetwork, config: FitConfig, number_type: torch.dtype) -> None:
        self._policy, self._config = policy, config
        self._trained = {name: each for name, each in policy.named_parameters() if each.requires_grad}
        self._reduced = policy.rows_independent and number_type == torch.bfloat16
        self._parts = _PARTS if policy.rows_independent else 1

    def of_step(self, frames: FrameSet, step: int) -> tuple[float, dict[str, Tensor]]:
        """Mean square error [rad^2] on a step's batch, and the gradient of each parameter that has one."""
        rng = np.random.default_rng([self._config.seed, step])
        rows = frames.training[rng.integers(0, len(frames.training), self._config.batch_size)]
        images, labels, goals = frames.batch(rows)
        changes = Changes.drawn(len(rows), self._config.augment, rng)
        parts: list[tuple[float, Sequence[Tensor | None]]] = [(0.0, ())] * self._parts
        bounds = slot_bounds(len(rows), self._parts)
        threads = torch.get_num_threads()

        def work(slot: int) -> None:
            torch.set_num_threads(max(1, threads // self._parts))  # of this thread
            some = slice(*bounds[slot])
            parts[slot] = self._of_part((images[some], labels[some], goals[some]), changes[some])

        with torch.random.fork_rng(devices=[]):  # for dropout's draws; later draws do not depend on them
            torch.manual_seed(int(np.random.default_rng([self._config.seed, step, 1]).integers(2**31)))
            try:
                run_slots(work, self._parts)
            finally:
                torch.set_num_threads(threads)
        found = zip(self._trained, *(gradients for _, gradients in parts), strict=True)
        sums = {name: _sum(each) for name, *each in found if each[0] is not None}
        return sum(squares for squares, _ in parts) / len(rows), sums

    def _of_part(self, batch: Batch, changes: Changes) -> tuple[float, Sequence[Tensor | None]]:
        """Sum of squared errors [rad^2], and the part's share of the gradients."""
        images, labels, goals = batch
        inputs = torch.from_numpy(changes.applied(images)).permute(0, 3, 1, 2)  # stays channels-last
        told, target = torch.from_numpy(goals) if self._policy.goal_size else None, torch.from_numpy(labels)
        with torch.autocast("cpu", torch.bfloat16, enabled=self._reduced):
            output: Tensor = self._policy(inputs, told).float()
        huber = F.huber_loss(output, target, delta=self._config.huber_rad, reduction="sum")
        loss = huber / (self._config.batch_size * self._config.huber_rad**2)
        gradients = torch.autograd.grad(loss, list(self._trained.values()), allow_unused=True)
        return float((output.detach() - target).square().sum()), gradients


def _sum(parts: Sequence[Tensor]) -> Tensor:
    total = parts[0]
    for part in parts[1:]:
        total.add_(part)
    return total


def _learning_rate(config: FitConfig, step: int) -> float:
    if step < config.warm_up_steps:
        return config.learning_rate * (step + 1) / config.warm_up_steps
    share = (step - config.warm_up_steps) / max(1, config.steps - config.warm_up_steps)
    return config.learning_rate * (0.01 + 0.99 * 0.5 * (1.0 + cos(pi * share)))


def _write(path: Path, policy: SteeringNetwork, optimiser: Adam, step: int, config: FitConfig) -> None:
    tensors = {f"weight.{name}": value.detach() for name, value in policy.state_dict().items()}
    for name, moments in optimiser.moments.items():
        tensors[f"first.{name}"], tensors[f"second.{name}"] = moments["exp_avg"], moments["exp_avg_sq"]
    # Copies, because the file holds each tensor of tied weights.
    contiguous = {name: value.contiguous().clone() for name, value in tensors.items()}
    header = {"step": str(step), "config": repr(asdict(config))}
    write_tensors(path, "torch", contiguous, header)


def _resume(
    path: Path, policy: SteeringNetwork, config: FitConfig
) -> tuple[int, dict[str, dict[str, Tensor]]]:
    """Load the checkpoint if it exists; returns the number of finished steps, and Adam's moments after them."""
    if not path.is_file():
        return 0, {}
    try:
        header, tensors = read_tensors(path, "torch")
    except (OSError, ValueError) as error:
        raise FrameStoreError(
            f"expected a training checkpoint at {path}, got {error}; delete it to start again"
        ) from error
    if header.get("config") != repr(asdict(config)):
        raise FrameStoreError(
            f"expected a checkpoint of the same settings at {path}; delete it to start again"
        )
    policy.load_state_dict(
        {k.removeprefix("weight."): v for k, v in tensors.items() if k.startswith("weight.")}
    )
    policy.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    step = int(header["step"])
    moments = {
        name: {
            "step": torch.tensor(float(step)),
            "exp_avg": tensors[f"first.{name}"],
            "exp_avg_sq": tensors[f"second.{name}"],
        }
        for name, _ in policy.named_parameters()
    }
    return step, moments
