"""The goal of an attack: the contract of an objective, and the built-in ones.

An objective judges drives. Its ``value`` is reported, and a search keeps the theta with the highest value. Gradients follow its ``loss``,
and searches without a gradient minimise it. The loss defaults to minus the value; an objective whose value is a count or a
maximum, or stops with the car, defines a relaxation.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from advnerf_core.driving.cross_track import cross_track
from advnerf_core.driving.metrics import DriveMetrics, Horizon, drive_metrics
from advnerf_core.driving.path import Path
from advnerf_core.driving.solids import Solids
from advnerf_core.errors import AdvnerfError
from advnerf_core.plugins import exit_refused, torch_left_as_it_is

# A path that turns by less over a drive has no outside [rad].
_LEAST_TURN_RAD = 0.2
# Slopes of a loss and of its value that are so alike are no relaxation's.
_SAME_WAY = 0.9


class ObjectiveError(AdvnerfError, ValueError):
    """An objective does not suit the place, or does not keep its contract."""


@dataclass(frozen=True, eq=False)
class JudgedDrives:
    """Drives from several starts, with the data that objectives need.

    Attributes:
        states: ``[T + 1, B, n]``: x [m], y [m], yaw [rad] first; ``states[0]`` are the starts. Gradients flow through them.
        path: Reference path of the car.
        horizon: Ticks, their length, and limits of the cross-track error.
        fence_m: Half side of the square beyond which the deployed car is stopped [m]; None without a fence.
        solids: Obstacles; None if the place does not define any.
    """

    states: Tensor
    path: Path
    horizon: Horizon
    fence_m: float | None = None
    solids: Solids | None = None

    @cached_property
    def cte_m(self) -> Tensor:
        """Signed cross-track error at the ticks 1..T, left positive, ``[T, B]`` [m], with gradients with respect to states."""
        return cross_track(self.path, self.states[1:, :, :2])

    @cached_property
    def metrics(self) -> tuple[DriveMetrics, ...]:
        """The protocol's metrics of each drive, without gradients; the car stops at the fence."""
        found = []
        for states in self.states.detach().cpu().numpy().swapaxes(0, 1):
            stopped = None
            if self.fence_m is not None:
                outside = np.flatnonzero((np.abs(states[:, :2]) > self.fence_m).any(axis=1))
                stopped = int(outside[0]) if outside.size else None
            found.append(drive_metrics(self.path, states, self.horizon, stopped))
        return tuple(found)

    @cached_property
    def clearances_m(self) -> Tensor:
        """Distance to each of K solids at the ticks 1..T, ``[T, B, K]`` [m], with gradients with respect to states.

        Raises:
            ObjectiveError: The place has no solids.
        """
        if self.solids is None:
            raise ObjectiveError(
                "expected a place that says what its car can hit, got one without solids; use another objective"
            )
        return self.solids.clearances_m(self.states[1:])

    @cached_property
    def outside(self) -> Tensor:
        """The sign that the cross-track error has outside of the path's turn, ``[B]``, for each drive.

        It is -1 if the heading of the path, over the distance that the car drives, departs furthest from its first one to the left, and 1
        if to the right.

        Raises:
            ObjectiveError: The path hardly turns.
        """
        positions = self.states.detach()[:, :, :2].cpu().numpy().astype(np.float64)
        driven_m = np.linalg.norm(np.diff(positions, axis=0), axis=-1).sum(0)
        start_m = self.path.project(positions[0]).s_m
        headings_rad = self.path.pose_at(start_m + np.linspace(0.0, 1.0, 65)[:, None] * driven_m)[..., 2]
        turned_rad = headings_rad - headings_rad[0]
        furthest_rad = np.take_along_axis(turned_rad, np.abs(turned_rad).argmax(0)[None], 0)[0]
        least = int(np.abs(furthest_rad).argmin())
        if abs(furthest_rad[least]) < _LEAST_TURN_RAD:
            raise ObjectiveError(
                f"expected a path with a turn for the objective run_wide, got one that turns by {furthest_rad[least]:.2f} rad over the "
                f"{driven_m[least]:.3g} m from the start; use cte, drift_left or drift_right"
            )
        return torch.from_numpy(-np.sign(furthest_rad)).to(self.states)

    def per_drive(self, values: list[float]) -> Tensor:
        """One number for each drive, ``[B]``, of the states' type."""
        return torch.tensor(values, dtype=self.states.dtype)


class Objective:
    """The goal of an attack. Derive from it, and define at least ``value``; see docs/methods.md.

    Attributes:
        title: Description in one line for lists.
        needs_solids: Whether it needs a place with solids.
    """

    title: ClassVar[str] = ""
    unit: ClassVar[str] = "m"
    needs_solids: ClassVar[bool] = False

    def value(self, drives: JudgedDrives) -> Tensor:
        """Success of the attacker in each drive, ``[B]``; higher is a stronger attack."""
        raise NotImplementedError(f"{type(self).__name__} has no value(); implement it")

    def loss(self, drives: JudgedDrives) -> Tensor:
        """Loss of each drive, ``[B]``, differentiable in ``drives.states``; minus the value unless it is overridden."""
        return -self.value(drives)


@dataclass(frozen=True)
class CrossTrackError(Objective):
    """``cte``: the total cross-track error.

    The value follows the protocol: ``sum_t |c_t|`` over t = 1..T, where the car stops at the fence and is then charged its last
    error, capped. The loss is ``-sum_t |c_t|`` of a car that continues beyond the fence, where the gradient would else be zero.
    """

    title = "Total cross-track error"

    def value(self, drives: JudgedDrives) -> Tensor:
        """Total |CTE| of each drive by the protocol, ``[B]`` [m]."""
        return drives.per_drive([each.total_cte_m for each in drives.metrics])

    def loss(self, drives: JudgedDrives) -> Tensor:
        """Minus the sum of |CTE|, ``[B]`` [m]."""
        return -drives.cte_m.abs().sum(0)


class ToOneSide(Objective, ABC):
    """How far the car drives to one side of its path: the common part of `DriftLeft`, `DriftRight` and `RunWide`.

    ``sum_t |c_t|`` has a maximum on either side of the path, and a gradient climbs the one on whose side the car happens to be. The value
    is ``sum_t s c_t`` by the protocol, and the loss ``-sum_t s c_t`` of a car that continues beyond the fence, with the sign s of
    one side.
    """

    @abstractmethod
    def side(self, drives: JudgedDrives) -> Tensor | float:
        """The sign s of all drives, or of each, ``[B]``: 1 is left."""

    def value(self, drives: JudgedDrives) -> Tensor:
        """Sum of the error to the side by the protocol, ``[B]`` [m]; negative on the other side."""
        return self.side(drives) * drives.per_drive([sum(each.ctes_m) for each in drives.metrics])

    def loss(self, drives: JudgedDrives) -> Tensor:
        """Minus the sum of the error to the side, ``[B]`` [m]."""
        return -self.side(drives) * drives.cte_m.sum(0)


@dataclass(frozen=True)
class RunWide(ToOneSide):
    """``run_wide``: how far the car runs wide of a turn, as a car that misses a turn is outside of it."""

    title = "How far the car runs wide of a turn"

    def side(self, drives: JudgedDrives) -> Tensor | float:
        """`JudgedDrives.outside`."""
        return drives.outside


@dataclass(frozen=True)
class DriftLeft(ToOneSide):
    """``drift_left``: how far the car drives to the left of its path."""

    title = "How far the car drives to the left of its path"

    def side(self, drives: JudgedDrives) -> Tensor | float:
        """1."""
        return 1.0


@dataclass(frozen=True)
class DriftRight(ToOneSide):
    """``drift_right``: how far the car drives to the right of its path."""

    title = "How far the car drives to the right of its path"

    def side(self, drives: JudgedDrives) -> Tensor | float:
        """-1."""
        return -1.0


@dataclass(frozen=True)
class Peak(Objective):
    """``peak``: the greatest cross-track error.

    The value is ``max_t |c_t|``. The loss is minus a smooth maximum, ``-w log(mean_t exp(|c_t| / w))`` with the temperature
    ``w = temperature * off_track_m``. It lies above minus the value, by at most ``w log T``.

    Attributes:
        temperature: Share of the off-track limit.
    """

    title = "Greatest cross-track error"

    temperature: float = 0.1

    def value(self, drives: JudgedDrives) -> Tensor:
        """Greatest |CTE| of each drive by the protocol, ``[B]`` [m]."""
        return drives.per_drive([each.max_cte_m for each in drives.metrics])

    def loss(self, drives: JudgedDrives) -> Tensor:
        """Minus the smooth maximum, ``[B]`` [m]."""
        width_m, ticks = self.temperature * drives.horizon.off_track_m, len(drives.cte_m)
        return -width_m * (torch.logsumexp(drives.cte_m.abs() / width_m, 0) - math.log(ticks))


@dataclass(frozen=True)
class TimeOffTrack(Objective):
    """``time_off_track``: how long the car is off the track.

    The value is ``dt`` times the ticks with ``|c_t| > off_track_m``. The loss replaces each of these steps by a sigmoid:
    ``-dt sum_t 1 / (1 + exp(-(|c_t| - off_track_m) / w))`` with ``w = width * off_track_m``.

    Attributes:
        width: Share of the off-track limit.
    """

    title = "Time off the track"

    unit: ClassVar[str] = "s"
    width: float = 0.25

    def value(self, drives: JudgedDrives) -> Tensor:
        """Time off the track of each drive by the protocol, ``[B]`` [s]."""
        limit_m, dt_s = drives.horizon.off_track_m, drives.horizon.dt_s
        return drives.per_drive(
            [dt_s * sum(abs(cte) > limit_m for cte in each.ctes_m) for each in drives.metrics]
        )

    def loss(self, drives: JudgedDrives) -> Tensor:
        """Minus the relaxed time off the track, ``[B]`` [s]."""
        limit_m = drives.horizon.off_track_m
        beyond = (drives.cte_m.abs() - limit_m) / (self.width * limit_m)
        return -drives.horizon.dt_s * torch.sigmoid(beyond).sum(0)


@dataclass(frozen=True)
class Collision(Objective):
    """``collision``: how deep the car drives into something solid.

    The value is ``-min d_tk`` over ticks t and solids k, where ``d_tk`` is the signed clearance (`Solids.clearances_m`): above 0 the car
    hits. The loss is minus the softplus of its smooth maximum, ``-w log(1 + sum_tk exp(-d_tk / w))`` with ``w = width * off_track_m``.
    The car of the surrogate drives on through obstacles.

    Attributes:
        width: Share of the off-track limit.
    """

    title = "How deep the car drives into something solid"

    needs_solids: ClassVar[bool] = True
    width: float = 0.5

    def value(self, drives: JudgedDrives) -> Tensor:
        """Minus the smallest clearance of each drive, ``[B]`` [m]."""
        return -drives.clearances_m.amin((0, 2))

    def loss(self, drives: JudgedDrives) -> Tensor:
        """Minus the softplus of the smooth maximum, ``[B]`` [m]."""
        width_m = self.width * drives.horizon.off_track_m
        nearest = torch.logsumexp(-drives.clearances_m / width_m, (0, 2))
        return -width_m * torch.nn.functional.softplus(nearest)


def values_of(objective: Objective, drives: JudgedDrives) -> Tensor:
    """The value of each drive, without history.

    Raises:
        ObjectiveError: The objective does not give one finite number for each drive.
    """
    return _judged(objective, "value", drives).detach().to(drives.states.dtype)


def losses_of(objective: Objective, drives: JudgedDrives) -> Tensor:
    """The loss of each drive, with its history.

    Raises:
        ObjectiveError: The objective does not give one finite number for each drive.
    """
    # Whole numbers and booleans have no mean, and no gradient that could be looked for.
    if type(objective).loss is Objective.loss:
        found = _judged(objective, "value", drives)
        return -(found if found.is_floating_point() else found.to(drives.states.dtype))
    found = _judged(objective, "loss", drives)
    return found if found.is_floating_point() else found.to(drives.states.dtype)


def loss_slopes(objective: Objective, drives: JudgedDrives) -> tuple[float, Tensor]:
    """The mean loss, and its derivative with respect to each state while all others are held, ``[T + 1, B, n]``.

    Raises:
        ObjectiveError: The loss is not differentiable in the states, or rises with the value, which a search would make small.
    """
    states = drives.states.detach().requires_grad_()
    with torch.enable_grad():
        loss = losses_of(objective, replace(drives, states=states)).mean()
        if not loss.requires_grad:
            raise ObjectiveError(
                f"expected a loss of {type(objective).__name__} that is differentiable in drives.states, got one without a gradient; "
                "compute it with torch from drives.states, drives.cte_m or drives.clearances_m, or search without a gradient"
            )
        (slopes,) = torch.autograd.grad(loss, states)
        if type(objective).__module__ != __name__ and type(objective).loss is not Objective.loss:
            _require_falling(objective, replace(drives, states=states), slopes)
    return float(loss.detach()), slopes


def _judged(objective: Objective, what: Literal["value", "loss"], drives: JudgedDrives) -> Tensor:
    seen = {"states": drives.states, "cte_m": drives.cte_m}
    before = {name: each.detach().clone() for name, each in seen.items()}
    found = _one_each(objective, what, _called(objective, what, drives), drives)
    for name, each in seen.items():
        if not torch.allclose(each.detach(), before[name], rtol=0.0, atol=0.0, equal_nan=True):
            raise ObjectiveError(
                f"expected {what} of {type(objective).__name__} to leave drives.{name} as it is, got other numbers in it after the call, which would be "
                "taken for the car's drive; write x = x - y instead of x -= y, and clamp instead of clamp_"
            )
    if type(objective).__module__ != __name__:
        _require_judged_alone(objective, what, drives, found)
    return found


def _require_falling(objective: Objective, drives: JudgedDrives, slopes: Tensor) -> None:
    """Raise for a loss whose slopes are those of the value; a value without slopes, such as a count, says nothing."""
    value = _judged(objective, "value", drives)
    if not value.requires_grad:
        return
    (up,) = torch.autograd.grad(value.mean(), drives.states, allow_unused=True)
    if up is None or not up.any():
        return
    cosine = float(torch.nn.functional.cosine_similarity(up.flatten(), slopes.flatten(), dim=0))
    if cosine > _SAME_WAY:
        raise ObjectiveError(
            f"expected a loss of {type(objective).__name__} that falls as its value rises, got one that rises with it (cosine of their slopes {cosine:+.2f}): "
            "a search makes the loss small and keeps the largest value; negate one of them"
        )


def _called(objective: Objective, what: Literal["value", "loss"], drives: JudgedDrives) -> object:
    with torch_left_as_it_is(), exit_refused():
        return getattr(objective, what)(drives)


def _require_judged_alone(
    objective: Objective, what: Literal["value", "loss"], drives: JudgedDrives, found: Tensor
) -> None:
    first = replace(drives, states=drives.states[:, :1].detach())
    with torch.no_grad():
        alone = _one_each(objective, what, _called(objective, what, first), first)
    one, other = float(found[0].detach()), float(alone[0])
    # Sums over a batch are rounded in another order.
    if not math.isclose(one, other, rel_tol=1e-3, abs_tol=1e-6):
        raise ObjectiveError(
            f"expected {what} of {type(objective).__name__} to judge each drive by that drive alone, and the same each time, got {one:.6g} for the first of "
            f"{len(found)} and {other:.6g} for it alone; sum over the ticks, dimension 0, draw no random numbers, and keep nothing between calls"
        )


def _one_each(objective: Objective, what: str, found: object, drives: JudgedDrives) -> Tensor:
    count = drives.states.shape[1]
    if not isinstance(found, Tensor) or tuple(found.shape) != (count,) or found.is_complex():
        got = (
            f"{found.dtype} of shape {list(found.shape)}"
            if isinstance(found, Tensor)
            else type(found).__name__
        )
        raise ObjectiveError(
            f"expected {what} of {type(objective).__name__} to return a tensor [{count}], one number for each drive, got {got}"
        )
    if not torch.isfinite(found).all() and torch.isfinite(drives.states).all():
        raise ObjectiveError(
            f"expected a finite {what} of {type(objective).__name__} for each drive, got {found.tolist()} of finite drives; look for a division by 0, "
            "or a root or logarithm of what may be negative"
        )
    return found
