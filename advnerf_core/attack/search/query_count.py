"""A victim that only answers queries, with a counter: attacks on black boxes are compared by the number of queries."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from advnerf_core.attack.methods import alternatives, black_box_methods
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.errors import AdvnerfError


class VictimError(AdvnerfError, TypeError):
    """This attack does not support the policy."""


class CountedPolicy:
    """A stateless policy behind a counter, which hides any gradient: an attack can only query it.

    One call is one image, alone or in a batch.

    Args:
        policy: The victim, in eval mode.

    Attributes:
        calls: Number of queried images.
    """

    stateless = True
    differentiable = False
    training = False

    def __init__(self, policy: Any) -> None:
        if not policy.stateless:
            raise VictimError(
                "expected a stateless policy, got one with memory: an image alone does not tell its steering; search with the "
                f"methods {alternatives(black_box_methods(stateless=False))} instead"
            )
        self._policy = policy
        self.calls = 0
        self.goal_size = int(getattr(policy, "goal_size", 0))

    @torch.no_grad()
    def __call__(self, images: Tensor, goals: Tensor | None = None) -> Tensor:
        """Steering ``[B]`` [rad], left positive, of images ``[B, 3, H, W]``; counted, without history."""
        self.calls += len(images)
        steering: Tensor = self._policy(images.detach(), goals)
        return steering.detach()


def calls_per_evaluation(problem: AttackProblem) -> int:
    """Policy calls of one closed-loop evaluation: one image per tick and start.

    The gradient attack's second pass through the policy, which a black box cannot answer, is not counted.
    """
    return problem.steps * len(problem.start_states)
