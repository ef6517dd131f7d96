"""The one closed loop: policy, sensor and dynamics, in the surrogate or a deployment scene, attacked or not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from advnerf_core.driving.dynamics import Motion
from advnerf_core.errors import NotFiniteError
from advnerf_core.policies.network import Policy

Observe = Callable[[Tensor], Tensor]
"""Images ``[B, 3, 66, 200]`` RGB 0..1 seen from states ``[B, n]``."""

# Torch's threads sleep between calls (`advnerf_core/__init__.py`). Waking them for so few images takes longer than they save.
_FEW_IMAGES = 4


@dataclass(frozen=True)
class Rollout:
    """Trajectories of one batch of starts.

    Attributes:
        states: ``[T + 1, B, n]``; ``states[t]`` is where the image for ``controls[t]`` was taken.
        controls: ``[T, B]`` steering [rad] (or turn rate [rad/s] for Dubins).
    """

    states: Tensor
    controls: Tensor


@torch.no_grad()
def drive(
    policy: Policy,
    observe: Observe,
    dynamics: Motion,
    start_states: Tensor,
    steps: int,
    goals: Tensor | None = None,
) -> Rollout:
    """Drive ``steps`` ticks from ``start_states [B, n]``; nothing is recorded for differentiation.

    Args:
        policy: Frozen policy in eval mode.
        observe: Sensor, called once per tick with the states ``[B, n]``.
        dynamics: Vehicle model, or a deployment scene that steps itself.
        start_states: ``[B, n]``; its dtype is the dtype of the rollout.
        steps: Number of ticks, at least one.
        goals: ``[B, goal_size]`` for goal-conditioned policies, constant over the drive.

    Raises:
        NotFiniteError: A control or state is NaN or infinite.
    """
    if steps < 1:
        raise ValueError(f"expected at least one step, got {steps}")
    # Room for all of it at once: small tensors kept from every tick, between the large ones that come and go, would
    # scatter the heap, and resident memory would grow with the horizon.
    states = start_states.new_empty(steps + 1, *start_states.shape)
    controls = start_states.new_empty(steps, len(start_states))
    states[0] = start_states
    for t in range(steps):
        controls[t] = _answer(policy, observe(states[t]), goals, t)
        states[t + 1] = dynamics.step(states[t], controls[t])
        if not bool(torch.isfinite(states[t + 1]).all()):
            raise NotFiniteError(
                f"expected a finite state of the car after tick {t}, got {_first_wrong(states[t + 1])} for finite steering; check the vehicle model, or "
                "the world that moves the car"
            )
    return Rollout(states, controls)


class Remembering:
    """A policy with memory during a drive.

    Args:
        policy: Called as ``policy(images, goals, memory) -> (steering, memory)``; it has ``initial_memory(batch)``.
        keep: Whether to keep all memories in ``memories``, which a gradient needs, instead of the last one. Past images are large.
    """

    stateless = True

    def __init__(self, policy: Any, batch: int, keep: bool = True) -> None:
        self._policy, self._keep = policy, keep
        self.memories: list[Tensor] = [policy.initial_memory(batch)]

    @staticmethod
    def afresh(policy: Any, batch: int) -> Policy:
        """A policy at the start of a drive: itself if it has no memory."""
        return policy if getattr(policy, "stateless", True) else Remembering(policy, batch, keep=False)

    def __call__(self, images: Tensor, goals: Tensor | None = None) -> Tensor:
        """Controls ``[B]`` of images ``[B, 3, H, W]``; the memory is carried over."""
        steering: Tensor
        steering, memory = self._policy(images, goals, self.memories[-1])
        if not self._keep:
            self.memories.clear()
        self.memories.append(memory)
        return steering


def _answer(policy: Policy, images: Tensor, goals: Tensor | None, tick: int) -> Tensor:
    """The policy's controls, which are finite."""
    controls = _steer(policy, images, goals)
    if bool(torch.isfinite(controls).all()):
        return controls
    if bool(torch.isfinite(images).all()):
        raise NotFiniteError(
            f"expected finite steering from the policy, got {_first_wrong(controls)} at tick {tick} for a picture without NaN; look in the policy for a "
            "division by a spread, a logarithm of zero, or damaged weights"
        )
    raise NotFiniteError(
        f"expected pictures without NaN for the policy, got {_first_wrong(images)} in that of tick {tick}; check the scene that renders them"
    )


def _first_wrong(numbers: Tensor) -> float:
    return float(numbers[~torch.isfinite(numbers)][0])


def _steer(policy: Policy, images: Tensor, goals: Tensor | None) -> Tensor:
    """The policy's controls; few images run on a single torch thread, with the same bits."""
    threads = torch.get_num_threads()
    if len(images) > _FEW_IMAGES:
        return policy(images, goals)
    torch.set_num_threads(1)
    try:
        return policy(images, goals)
    finally:
        torch.set_num_threads(threads)
