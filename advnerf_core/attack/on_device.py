"""Searches on a GPU: the problem's sensor and policy are moved there, everything else stays on the CPU."""

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
    """The problem for a search on the device that `use_device` chose; unchanged on the CPU.

    Raises:
        DeviceError: The device is not available, or it cannot render the searched objects.
    """
    if not searches_on_gpu():
        return problem
    # Imported here: the compiler of GPU kernels takes a while to load, and may be absent.
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
    """Device metadata for an attack file: empty on the CPU."""
    if not searches_on_gpu():
        return {}
    return {"device": torch.cuda.get_device_name() if torch.cuda.is_available() else "simulated GPU"}


class PolicyThere:
    """A frozen policy that takes images on a device and steers on the CPU; differentiable as the policy is.

    A torch network is copied to the device. A policy without torch weights, such as ONNX, stays on the CPU, and the images are
    copied to it.

    Args:
        policy: The policy, in eval mode.
    """

    def __init__(self, policy: Any, device: torch.device) -> None:
        moves = isinstance(policy, nn.Module) and any(True for _ in policy.parameters())
        self._policy = copy.deepcopy(policy).to(device) if moves else policy
        self._device = device if moves else torch.device("cpu")
        self.stateless: bool = policy.stateless
        self.differentiable = bool(getattr(policy, "differentiable", True))
        self.training = bool(getattr(policy, "training", False))
        self.goal_size = int(getattr(policy, "goal_size", 0))
        # Deterministic bits, and no convolutions in TF32: gradients keep their direction.
        torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = True, False
        torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False

    def initial_memory(self, batch: int) -> Tensor:
        """Memory ``[B, ...]`` of a policy that has one."""
        memory: Tensor = self._policy.initial_memory(batch)
        return memory.cpu()

    def __call__(self, images: Tensor, goals: Tensor | None = None, *memory: Tensor) -> Any:
        """The policy's outputs on the CPU for images on any device."""
        there = [None if each is None else each.to(self._device) for each in (images, goals, *memory)]
        given = self._policy(*there)
        return given.cpu() if isinstance(given, Tensor) else tuple(each.cpu() for each in given)
