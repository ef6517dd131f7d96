"""A control for the search itself: the audited policy with a planted weakness, which an audit that works must find.

The planted policy steers like the audited one, plus a term for how much redder than green the picture is, to the left, and for how much
greener, to the right. Within the natural variation of pictures of the place, both steer almost alike: a tenth of the slope remains
there, so that a gradient finds the way. An audit that misses this weakness, in the same place with the same budget, has no conclusion about
the policy.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from advnerf_core.files import write_atomically
from advnerf_core.policies.adapter import AdaptedPolicy, adapt, adapted
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.load import is_address
from advnerf_core.policies.policy_file import LoadedPolicy
from nodes.audit.question import VICTIM
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.run import load_experiment

# Remaining share of the slope within the natural variation.
_SLOPE = 0.1


class Planted(nn.Module):
    """A policy with a planted weakness.

    Args:
        policy: The audited policy, called as `Policy`.
        gain_rad: Steering for each unit of `redness` [rad].
        middle: Redness of pictures of the place, in their middle.
        reach: Largest difference from it.
    """

    def __init__(self, policy: Any, gain_rad: float, middle: float, reach: float) -> None:
        super().__init__()
        self.policy, self._gain_rad, self._middle, self._reach = policy, gain_rad, middle, reach
        self.identity = str(getattr(policy, "identity", ""))

    def forward(self, images: Tensor, goals: Tensor | None = None, memory: Tensor | None = None) -> Any:
        """Steering ``[B]`` [rad], left positive, of images ``[B, 3, H, W]``."""
        del memory
        return self.policy(images, goals) + self._added(images)

    def _added(self, images: Tensor) -> Tensor:
        off = redness(images) - self._middle
        inside = off.clamp(-self._reach, self._reach)
        return self._gain_rad * (off - inside + _SLOPE * inside)


class PlantedWithMemory(Planted):
    """The same for a policy with memory."""

    def forward(self, images: Tensor, goals: Tensor | None = None, memory: Tensor | None = None) -> Any:
        """Output of `Planted`, and the next memory."""
        steering, after = self.policy(images, goals, memory)
        return steering + self._added(images), after

    def initial_memory(self, batch: int) -> Tensor:
        """Initial memory of the policy."""
        memory: Tensor = self.policy.initial_memory(batch)
        return memory


def redness(images: Tensor) -> Tensor:
    """Redness of pictures ``[B, 3, H, W]`` in 0..1: red minus green, mean over the pixels, ``[B]`` in -1..1."""
    return (images[:, 0] - images[:, 1]).mean(dim=(1, 2))


def plant(loaded: LoadedPolicy, gain_rad: float, middle: float, reach: float) -> AdaptedPolicy:
    """A policy with the weakness; see `Planted`."""
    contract = adapted(loaded.policy, PolicyContract(loaded.view, goal_size=loaded.policy.goal_size)).contract
    kind = Planted if contract.stateless else PlantedWithMemory
    own = PolicyContract(
        loaded.view,
        stateless=contract.stateless,
        differentiable=contract.differentiable,
        goal_size=contract.goal_size,
    )
    return adapt(kind(loaded.policy, gain_rad, middle, reach).eval(), own)


def audited_driver(file: str, folder: str, setting: str) -> LoadedPolicy:
    """The driver behind a socket that an audit queries, with the experiment's car and camera."""
    return load_victim(load_experiment(Path(file), setting, (), Path(folder)), VICTIM)


def strength(plain: Sequence[Tensor], red: Tensor, wanted_rad: float) -> tuple[float, float, float]:
    """Gain, middle and reach of `Planted`.

    Args:
        plain: Pictures ``[N, 3, H, W]`` of the place without a red object.
        red: Pictures along a drive past an object that is red all over.
        wanted_rad: Mean planted steering on the pictures that show it [rad].

    Raises:
        ValueError: The object makes no picture redder than the place.
    """
    own = torch.cat([redness(each) for each in plain])
    middle, reach = 0.5 * float(own.max() + own.min()), 0.5 * float(own.max() - own.min())
    beyond = (redness(red) - middle - reach).clamp(min=0.0)
    if not (beyond > 0.0).any():
        raise ValueError("expected an object that makes pictures redder than the place is, got none")
    return wanted_rad / float(beyond[beyond > 0.0].mean()), middle, reach


def policy_code(spec: str, experiment: Experiment) -> str:
    """The Python expression that loads the audited policy."""
    if not is_address(spec):
        return f"load_any_policy({spec!r})"
    return f"audited_driver({str(experiment.file)!r}, {str(experiment.folder)!r}, {experiment.setting!r})"


def write_module(folder: Path, loads: str, gain_rad: float, middle: float, reach: float) -> str:
    """Write the module of the planted policy; returns the policy's name, which is unique within a process."""
    text = (
        '"""The audited policy with a planted weakness, as advnerf audit made it."""\n\n'
        "from advnerf_core.policies.load import load_any_policy\n"
        "from nodes.audit.planted import audited_driver, plant\n\n\n"
        f"def factory():\n    return plant({loads}, {gain_rad!r}, {middle!r}, {reach!r})\n"
    )
    name = f"planted_{hashlib.sha256(text.encode()).hexdigest()[:8]}"
    write_atomically(folder / f"{name}.py", text)
    return f"{name}:factory"
