"""Searches on a GPU: the sensor and the policy of a problem go there, everything else stays on the processor."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from advnerf_core.attack.device import searches_on_gpu
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.attack.spaces.displayed import DisplayedSensor


def on_chosen_device(problem: AttackProblem) -> AttackProblem:
    """The problem as a search on the device that `use_device` chose sees it; itself on the processor.

    Raises:
        DeviceError: There is no such device, or it cannot show what is searched.
    """
    if not searches_on_gpu():
        return problem
    # Only here: the compiler of kernels for a GPU takes a while to load, and may be absent.
    from advnerf_core.scene.cuda_surrogate import on_cuda

    behind = problem.sensor.sensor if isinstance(problem.sensor, DisplayedSensor) else problem.sensor
    there = on_cuda(behind)
    sensor = replace(problem.sensor, sensor=there) if isinstance(problem.sensor, DisplayedSensor) else there
    return replace(problem, sensor=sensor, policy=PolicyThere(problem.policy, there.device))


def all_on_chosen_device(problems: Sequence[AttackProblem]) -> list[AttackProblem]:
    """Problems that differ in starts, goals and draws only, on the chosen device, where they share one sensor and one policy."""
    first = on_chosen_device(problems[0])
    return [replace(each, sensor=first.sensor, policy=first.policy) for each in problems]


def said_of_device() -> dict[str, str]:
    """What an attack file says of the device it was searched on: nothing on the processor."""
    if not searches_on_gpu():
        return {}
    return {"device": torch.cuda.get_device_name() if torch.cuda.is_available() else "simulated GPU"}


class PolicyThere:
    """A frozen policy that takes images on a device and steers on the processor; differentiable as the policy is.

    A network of torch is copied to the device. One without weights of torch, such as an ONNX policy, stays where it is, and the images are
    brought to it.

    Args:
        policy: In eval mode.
    """

    def __init__(self, policy: Any, device: torch.device) -> None:
        moves = isinstance(policy, nn.Module) and any(True for _ in policy.parameters())
        self._policy = copy.deepcopy(policy).to(device) if moves else policy
        self._device = device if moves else torch.device("cpu")
        self.stateless: bool = policy.stateless
        self.differentiable = bool(getattr(policy, "differentiable", True))
        self.training = bool(getattr(policy, "training", False))
        self.goal_size = int(getattr(policy, "goal_size", 0))
        # The same bits every time, and no convolutions of ten bits: gradients keep their direction.
        torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = True, False
        torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False

    def initial_memory(self, batch: int) -> Tensor:
        """Memory ``[B, ...]`` of a policy that has one."""
        memory: Tensor = self._policy.initial_memory(batch)
        return memory.cpu()

    def __call__(self, images: Tensor, goals: Tensor | None = None, *memory: Tensor) -> Any:
        """What the policy gives for images on any device, on the processor."""
        there = [None if each is None else each.to(self._device) for each in (images, goals, *memory)]
        given = self._policy(*there)
        return given.cpu() if isinstance(given, Tensor) else tuple(each.cpu() for each in given)
