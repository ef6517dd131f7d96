"""Predicts how far an attack will drive the deployed car off its path, before it is deployed.

Model. On held-out real views the object is composed into the picture, and the policy runs with and without it. That gives the share
``r`` of the attack's effect on the steering that survives in real pictures, its residuals, and the disagreement ``d = learned - real`` of
the steering on views without the attack. Then the loop is driven in the surrogate with a steering as a real picture would give it::

    u_t = pi(plain_t) - d_t + r (pi(attacked_t) - pi(plain_t)) + e_t

where ``d`` and ``e`` are drawn from the measured values, in blocks of neighbouring views, as errors along a path are alike from tick to tick
(block bootstrap, Kunsch 1989). Several draws give a distribution of the total CTE. The baseline without attack is predicted in the same way, so that
the excess is predicted too. The car is the problem's: give it the deployed car's measured response
(`advnerf_core.driving.measured_car`). The model ignores obstacles other than the fence, and states far from the held-out views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.attack.objective import JudgedDrives
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.driving.dynamics import Motion
from advnerf_core.driving.metrics import Horizon
from advnerf_core.driving.rollout import drive
from advnerf_core.scene.fidelity import Effect, SceneAgreement

Floats = NDArray[np.float64]
_BLOCK = 8
# A next drive lies below the smallest of n draws with probability 1 / (n + 1): fewer draws give no 10 % quantile.
FEWEST_DRAWS = 9
DEFAULT_DRAWS = 20


AttackableScene = Callable[[Tensor, bool], Tensor]
"""Images ``[B, 3, H, W]`` seen from states ``[B, n]``, with or without the attack."""


@dataclass(frozen=True)
class TransferPrediction:
    """Predicted total CTE of a deployed attack.

    Attributes:
        attacked_m: Total CTE of each draw with the attack [m].
        none_m: Total CTE of each draw without the attack [m].
        retained: Share of the effect on the steering that survives in real pictures.
        ticks: Ticks of a drive.
    """

    attacked_m: tuple[float, ...]
    none_m: tuple[float, ...]
    retained: float
    ticks: int

    @property
    def excess_m_per_tick(self) -> tuple[float, float, float]:
        """Excess |CTE| per tick of one drive [m], each draw against the same draw without attack: low end of the 80 % band, mean, and high end."""
        excess = (np.array(self.attacked_m) - np.array(self.none_m)) / self.ticks
        low, high = _band(excess)
        return low, float(excess.mean()), high

    def record(self) -> dict[str, Any]:
        """JSON-ready values."""
        excess_low_m, excess_m, excess_high_m = self.excess_m_per_tick
        return {
            "excess_low_m": excess_low_m,
            "excess_m": excess_m,
            "excess_high_m": excess_high_m,
            "retained": self.retained,
            "draws": len(self.attacked_m),
            "total_cte_m": float(np.mean(self.attacked_m)),
            "none_total_cte_m": float(np.mean(self.none_m)),
        }


def predict_transfer(
    problem: AttackProblem,
    car: Motion,
    images: AttackableScene,
    clean: SceneAgreement,
    effect: Effect,
    starts: Tensor,
    horizon: Horizon,
    draws: int = DEFAULT_DRAWS,
    seed: int = 0,
    none_m: tuple[float, ...] | None = None,
) -> TransferPrediction:
    """Predict deployed drives with and without an attack.

    Args:
        problem: Policy, path, goals and limits; the car that it is searched with, and its start states, are not used.
        car: The deployed car.
        clean: Agreement of the steering on held-out views without attack, in the order of the path.
        effect: Effect of this attack on the same views.
        starts: Start states ``[S, n]`` of the deployed drives; the draws take turns.
        draws: Drives of each kind.
        none_m: The draws without attack from a prediction with the same clean views, starts, draws and seed; they do not
            depend on the attack.

    Returns:
        The prediction.

    Raises:
        ValueError: Fewer than `FEWEST_DRAWS` draws.
    """
    if draws < FEWEST_DRAWS:
        raise ValueError(f"expected at least {FEWEST_DRAWS} draws for a band that holds 80 %, got {draws}")
    rng = np.random.default_rng(seed)
    disagreement = _blocks(clean.difference, horizon.ticks, draws, rng)
    residual = _blocks(effect.residual, horizon.ticks, draws, rng)
    starts = starts[torch.arange(draws) % len(starts)].contiguous()
    goals = None if problem.goals is None else problem.goals[:1].expand(draws, -1)
    totals = {} if none_m is None else {False: none_m}
    for attacked in (True, False) if none_m is None else (True,):
        share = effect.retained if attacked else 0.0
        noise = torch.from_numpy(residual - disagreement if attacked else -disagreement)
        policy = _AsDeployed(problem.policy, images, share, noise, attacked)
        rollout = drive(policy, lambda states: states, car, starts, horizon.ticks, goals)
        limits = replace(horizon, held_cap_m=problem.held_cap_m)
        judged = JudgedDrives(rollout.states.double(), problem.path, limits, problem.fence_m)
        totals[attacked] = tuple(each.total_cte_m for each in judged.metrics)
    return TransferPrediction(totals[True], totals[False], effect.retained, horizon.ticks)


def _band(values: Floats) -> tuple[float, float]:
    """Band that holds the next value of the same kind in 80 % of cases.

    The k-th of n sorted values is the k / (n + 1) quantile of what comes next. Quantiles interpolated between the smallest and the
    largest, NumPy's default, hold only 62 % with eight values.
    """
    low, high = np.quantile(values, (0.1, 0.9), method="weibull")
    return float(low), float(high)


def _blocks(values: Floats, ticks: int, draws: int, rng: np.random.Generator) -> Floats:
    """Blocks of neighbouring values, one after the other, ``[ticks, draws]``."""
    length = min(_BLOCK, len(values))
    starts = rng.integers(0, len(values) - length + 1, (draws, -(-ticks // length)))
    indices = (starts[..., None] + np.arange(length)).reshape(draws, -1)[:, :ticks]
    return np.ascontiguousarray(values[indices].T)


class _AsDeployed:
    """The policy for `drive`: its image is the state itself, from which it renders with and without the attack."""

    stateless = True

    def __init__(
        self, policy: Any, images: AttackableScene, share: float, noise: Tensor, attacked: bool
    ) -> None:
        self._policy, self._images, self._share, self._noise, self._attacked = (
            policy,
            images,
            share,
            noise,
            attacked,
        )
        self._tick = 0

    def __call__(self, images: Tensor, goals: Tensor | None = None) -> Tensor:
        plain = self._policy(self._images(images, False), goals)
        steering = plain
        if self._attacked:
            steering = plain + self._share * (self._policy(self._images(images, True), goals) - plain)
        self._tick += 1
        return torch.as_tensor(steering + self._noise[self._tick - 1].to(steering.dtype))
