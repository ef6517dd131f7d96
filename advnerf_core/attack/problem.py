"""Inputs of an attack: a frozen policy, a differentiable sensor, dynamics, a path and start poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from advnerf_core.attack.objective import (
    CrossTrackError,
    JudgedDrives,
    Objective,
    ObjectiveError,
    losses_of,
    values_of,
)
from advnerf_core.attack.robustness import Disturbances, PosedSensor
from advnerf_core.driving.dynamics import Dynamics
from advnerf_core.driving.metrics import LAB_OFF_TRACK_M, Horizon
from advnerf_core.driving.path import Path
from advnerf_core.driving.solids import Solids
from advnerf_core.errors import AdvnerfError, NotFiniteError
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.scene.surrogate import Rendered

Regulariser = Callable[[Tensor], tuple[float, Tensor]]
"""``theta -> (part of the loss, its gradient)``, for example `Smoothness`."""


class BlackBoxError(AdvnerfError, TypeError):
    """A gradient was requested from a policy that has none."""


class NoColoursError(AdvnerfError, TypeError):
    """A search that needs colours got other parameters."""


class ZeroGradientError(AdvnerfError, ValueError):
    """A search along a gradient begins where the gradient is exactly zero: every drive of it would be the first one again.

    Attributes:
        theta: Parameters of the first drive.
    """

    def __init__(self, theta: Tensor) -> None:
        super().__init__(
            f"expected a gradient to follow, got exactly zero for all {theta.numel()} parameters at the first drive: no picture shows the objects, or "
            "the policy's steering does not depend on them (argmax, rounding, clamping, a saturated output), or the objective not on the drive; "
            "'advnerf attack check' says which; methods without a gradient may still work"
        )
        self.theta = theta


def require_finite_parameters(theta: Tensor) -> None:
    """Refuse parameters with NaN or infinity, before a drive that would blame the scene for them.

    Raises:
        NotFiniteError: There are some.
    """
    wrong = theta.numel() - int(torch.isfinite(theta).sum())
    if wrong:
        raise NotFiniteError(
            f"expected finite parameters to drive with, got NaN or infinity in {wrong} of {theta.numel()}; check the steps of the method that proposed "
            "them, or the file that they are from"
        )


class Sensor(Protocol):
    """A differentiable sensor; the attack does not depend on its renderer."""

    @property
    def theta_shape(self) -> tuple[int, ...]:
        """Shape of the attacked parameters."""

    def initial_theta(self, generator: torch.Generator) -> Tensor:
        """Initial parameters of an attack, ``theta_shape``."""

    def sense(self, states: Tensor, theta: Tensor) -> Rendered:
        """Images at detached states ``[B, n]`` and parameters ``theta`` (``theta_shape``), with their vjp."""


@runtime_checkable
class ColouringSensor(Protocol):
    """A sensor whose theta is the objects' colours, in order, such as a ``Surrogate``."""

    @property
    def objects(self) -> Sequence[ColouredObject]:
        """The objects; one, or several."""

    def plain_theta(self) -> Tensor:
        """The objects' colours without an attack, ``theta_shape``."""


@runtime_checkable
class ScaledSensor(Protocol):
    """A sensor whose theta is not colours before squashing, so that searches need other steps and spreads."""

    @property
    def learning_rate(self) -> float:
        """Step of Adam along a gradient, in units of theta."""

    @property
    def random_sigma(self) -> float:
        """Spread of random thetas."""


@dataclass(frozen=True, eq=False)
class AttackProblem:
    """Everything an attack needs except ``theta``.

    Attributes:
        policy: Frozen policy in eval mode; ``stateless`` decides which adjoint is used. One with memory has ``initial_memory(B)``,
            ``[B, ...]``, takes a memory after the goals, and returns the next one after the steering.
        sensor: Differentiable sensor, usually a ``Surrogate``.
        dynamics: Vehicle model with Jacobians.
        path: Reference path.
        start_states: ``[B, n]``; states and lambdas have their dtype.
        steps: Horizon T in control ticks.
        goals: ``[B, goal_size]`` or None.
        time_batch: Steps whose policy gradients are evaluated at once.
        cache_bytes: Budget for renders kept from the forward to the backward pass [bytes]; 0 keeps none.
        fence_m: Half side of the square |x|, |y| beyond which the car is stopped in deployment [m]; None if there is no fence.
            It affects reported values only: the built-in losses continue beyond it, as their gradients would else be zero.
        held_cap_m: Cap of the |CTE| that a stopped car is charged per tick in the reported total [m].
        off_track_m: |CTE| beyond which the car is off the track [m]; it decides whether the drive without an attack stays on it.
        disturbances: Random disturbances of the images; None changes nothing.
        draw: Number of the disturbances' draw; searches count their evaluations here.
        regulariser: Added to the loss, for example `Smoothness`; None adds nothing.
        objective: The objective that the attack maximises.
        solids: Obstacles, for objectives that need them.
        reduced: Compute the policy's gradients in bfloat16; see `image_gradients.agrees_in_bfloat16`.
    """

    policy: Any
    sensor: Sensor
    dynamics: Dynamics
    path: Path
    start_states: Tensor
    steps: int
    goals: Tensor | None = None
    time_batch: int = 8
    cache_bytes: int = 256 * 2**20
    fence_m: float | None = None
    held_cap_m: float = 1.5
    off_track_m: float = LAB_OFF_TRACK_M
    disturbances: Disturbances | None = None
    draw: int = 0
    regulariser: Regulariser | None = None
    objective: Objective = field(default_factory=CrossTrackError)
    solids: Solids | None = None
    reduced: bool = False

    def __post_init__(self) -> None:
        """Reject combinations that would give a wrong gradient silently."""
        if getattr(self.policy, "training", False):
            raise ValueError("expected the policy in eval mode, got one in training mode; call policy.eval()")
        size = self.dynamics.state_size
        if self.start_states.ndim != 2 or self.start_states.shape[1] != size:
            raise ValueError(f"expected start states [B, {size}], got {list(self.start_states.shape)}")
        if self.steps < 1 or self.time_batch < 1 or self.cache_bytes < 0:
            raise ValueError(
                "expected steps >= 1, time_batch >= 1 and cache_bytes >= 0, "
                f"got {self.steps}, {self.time_batch} and {self.cache_bytes}"
            )

        moved = self.disturbances is not None and self.disturbances.moves_the_camera
        if moved and not isinstance(self.sensor, PosedSensor):
            raise ValueError(
                "expected a sensor with camera_poses and render for camera jitter, got one without"
            )
        if self.objective.needs_solids and self.solids is None:
            raise ObjectiveError(
                f"expected a place with solids for the objective {type(self.objective).__name__}, got one that does not say what its car can "
                "hit; choose another place, or the objective cte"
            )

    @property
    def differentiable(self) -> bool:
        """Whether the policy has a gradient; a policy without one declares ``differentiable = False``."""
        return bool(getattr(self.policy, "differentiable", True))

    def require_gradient(self) -> None:
        """Raise for a policy without a gradient.

        Raises:
            BlackBoxError: The policy declares that it has none.
        """
        if not self.differentiable:
            raise BlackBoxError(
                "expected a policy with a gradient, got one that declares differentiable = False; search with a "
                "method that asks for answers only (advnerf experiment list methods)"
            )

    def coloured(self, method: str) -> ColouringSensor:
        """The sensor, whose theta must be colours for a method to search them.

        Raises:
            NoColoursError: The sensor's theta is not colours, but shapes or places.
        """
        if not isinstance(self.sensor, ColouringSensor):
            raise NoColoursError(
                f"expected colours of objects for the method {method}, got the parameters of a {type(self.sensor).__name__}; "
                "use the methods random or gradient"
            )
        return self.sensor

    def sense(self, ticks: Sequence[int], states: Tensor, theta: Tensor) -> Rendered:
        """The policy's images at some ticks of a drive.

        Args:
            ticks: Tick numbers.
            states: ``[ticks * B, n]``, ordered by tick.
            theta: Parameters of the objects, ``theta_shape``.
        """
        if self.disturbances is None:
            return self.sensor.sense(states, theta)
        if self.disturbances.moves_the_camera:
            assert isinstance(self.sensor, PosedSensor)
            poses = self.disturbances.camera_poses(self.sensor.camera_poses(states), ticks, self.draw)
            rendered = self.sensor.render(poses, theta)
        else:
            rendered = self.sensor.sense(states, theta)
        return self.disturbances.disturb(rendered, ticks, self.draw)

    def at_draw(self, draw: int) -> AttackProblem:
        """The problem of one evaluation of a search; itself if it has no disturbances."""
        return self if self.disturbances is None else replace(self, draw=draw)

    def undisturbed(self) -> AttackProblem:
        """The same problem without disturbances and regulariser, as attacks are judged."""
        if self.disturbances is None and self.regulariser is None:
            return self
        return replace(self, disturbances=None, draw=0, regulariser=None)

    def judged(self, states: Tensor) -> JudgedDrives:
        """Drives of states ``[T + 1, B, n]`` in the form that an objective judges."""
        horizon = Horizon(self.steps, self.dynamics.dt_s, self.off_track_m, self.held_cap_m)
        return JudgedDrives(states, self.path, horizon, self.fence_m, self.solids)

    def losses(self, states: Tensor) -> Tensor:
        """Loss ``[B]`` of each drive of states ``[T + 1, B, n]``, without the regulariser; differentiable in the states."""
        return losses_of(self.objective, self.judged(states))

    def totals(self, states: Tensor) -> Totals:
        """Loss, value and cross-track errors of each drive of states ``[T + 1, B, n]``."""
        drives = self.judged(states.detach())
        protocol = drives.per_drive([each.total_cte_m for each in drives.metrics])
        losses = losses_of(self.objective, drives).detach()
        return Totals(drives.cte_m.abs().sum(0), protocol, losses, values_of(self.objective, drives))


@dataclass(frozen=True, eq=False)
class Totals:
    """Sums over each start's rollout.

    Attributes:
        total_cte_m: |CTE| summed over t = 1..T, ``[B]`` [m].
        protocol_cte_m: Total |CTE| by the protocol (``driving/metrics``), for comparison between domains: the car stops at the fence, ``[B]`` [m].
        losses: Loss of the problem's objective, ``[B]``.
        values: Value of the problem's objective, ``[B]``.
    """

    total_cte_m: Tensor
    protocol_cte_m: Tensor
    losses: Tensor
    values: Tensor

    def rows(self, chosen: slice) -> Totals:
        """Totals of some starts."""
        return Totals(
            self.total_cte_m[chosen], self.protocol_cte_m[chosen], self.losses[chosen], self.values[chosen]
        )
