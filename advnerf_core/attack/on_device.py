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
from advnerf_core.attack.spaces.placed_sensor import PlacedSensor
from advnerf_core.errors import DeviceError
from advnerf_core.scene.device import device_name, use_exact_arithmetic
from advnerf_core.scene.device_surrogate import DeviceSurrogate
from advnerf_core.scene.surrogate import Surrogate


def on_chosen_device(problem: AttackProblem) -> AttackProblem:
    """The problem for a search on the device that `use_device` chose; unchanged on the CPU.

    Raises:
        DeviceError: There is no GPU, or it cannot render the searched objects.
    """
    device = _chosen()
    return problem if device is None else on_device(problem, device)


def on_device(problem: AttackProblem, device: torch.device) -> AttackProblem:
    """The problem with its sensor and its policy on a device.

    Raises:
        DeviceError: The device cannot render the sensor.
    """
    sensor = problem.sensor
    there = (
        replace(sensor, sensor=sensor_on(sensor.sensor, device))
        if isinstance(sensor, DisplayedSensor)
        else sensor_on(sensor, device)
    )
    return replace(problem, sensor=there, policy=PolicyThere(problem.policy, device))


def sensor_on(sensor: Any, device: torch.device) -> DeviceSurrogate | PlacedSensor:
    """A sensor on a device.

    Raises:
        DeviceError: The sensor is neither a surrogate nor places objects, or has objects that a GPU cannot draw.
    """
    if isinstance(sensor, PlacedSensor):
        return sensor.on(device)
    if not isinstance(sensor, Surrogate):
        raise DeviceError(
            f"expected a search for colours or places of objects on a GPU, got the sensor {type(sensor).__name__}; "
            "leave --device out to search on the processor"
        )
    return DeviceSurrogate(sensor, device)


def all_on_chosen_device(problems: Sequence[AttackProblem]) -> list[AttackProblem]:
    """Problems that differ in starts, goals and draws only, on the chosen device, where they share one sensor and one policy."""
    first = on_chosen_device(problems[0])
    return [replace(each, sensor=first.sensor, policy=first.policy) for each in problems]


def said_of_device() -> dict[str, str]:
    """Device metadata for an attack file: empty on the CPU."""
    device = _chosen()
    return {} if device is None else {"device": device_name(device)}


def _chosen() -> torch.device | None:
    if not searches_on_gpu():
        return None
    # Imported here, as it loads every part that it checks.
    from advnerf_core.scene.agreement import search_device

    return search_device()


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
        use_exact_arithmetic()

    def initial_memory(self, batch: int) -> Tensor:
        """Memory ``[B, ...]`` of a policy that has one."""
        memory: Tensor = self._policy.initial_memory(batch)
        return memory.cpu()

    def __call__(self, images: Tensor, goals: Tensor | None = None, *memory: Tensor) -> Any:
        """The policy's outputs on the CPU for images on any device."""
        there = [None if each is None else each.to(self._device) for each in (images, goals, *memory)]
        given = self._policy(*there)
        return given.cpu() if isinstance(given, Tensor) else tuple(each.cpu() for each in given)
