"""Planar vehicle models with exact arcs and closed-form Jacobians, for rollouts and for the adjoint.

A control is held over one tick, so the yaw rate is constant and the rear axle moves on a circular arc. With
``h = yaw_rate * dt / 2`` its chord is ``v * dt * sin(h) / h`` long and points to ``yaw + h``; this holds for straight
lines too. The models are Dubins' car (L. E. Dubins, 1957) and the kinematic bicycle at the rear axle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

# The car's servo stops at 0.85 (right) and 0.15 (left); the servo gain and offset turn that into these angles.
STEERING_LIMITS_RAD = (-0.2634, 0.3135)


class Motion(Protocol):
    """A car that can be driven: ``x' = f(x, u)`` on states ``[B, n]`` whose first three entries are x [m], y [m], yaw [rad]."""

    @property
    def state_size(self) -> int:
        """Number of state entries, ``n``."""

    def step(self, states: Tensor, controls: Tensor) -> Tensor:
        """States ``[B, n]`` one tick after ``states [B, n]`` under the controls ``[B]``, held over the tick."""


class Dynamics(Motion, Protocol):
    """A vehicle model that attacks are searched through: a motion with closed-form Jacobians."""

    @property
    def dt_s(self) -> float:
        """Length of one control tick [s]."""

    def jacobians(self, states: Tensor, controls: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives ``(df_dx [B, n, n], df_du [B, n])`` of :meth:`step`."""


@dataclass(frozen=True)
class Dubins:
    """Constant speed, the control is the turn rate [rad/s].

    Attributes:
        speed_mps: Forward speed [m/s].
        dt_s: Length of one tick [s].
    """

    speed_mps: float
    dt_s: float

    def __post_init__(self) -> None:
        _require_positive(speed_mps=self.speed_mps, dt_s=self.dt_s)

    @property
    def state_size(self) -> int:
        """Number of states: x, y, yaw."""
        return 3

    def step(self, states: Tensor, controls: Tensor) -> Tensor:
        """One tick; see :class:`Dynamics`."""
        _check(states, controls, self.state_size)
        return _arc_step(states, controls, self.speed_mps, self.dt_s)

    def jacobians(self, states: Tensor, controls: Tensor) -> tuple[Tensor, Tensor]:
        """Closed form; see :class:`Dynamics`."""
        _check(states, controls, self.state_size)
        return _arc_jacobians(states, controls, self.speed_mps, self.dt_s)


@dataclass(frozen=True)
class Ackermann:
    """Kinematic bicycle at the rear axle with constant speed; the control is the steering angle [rad], left positive.

    Steering beyond the limits is clamped, and there the derivative with respect to the control is zero (at the limit
    itself it is the one-sided derivative from inside, as in ``torch.clamp``).

    Attributes:
        wheelbase_m: Distance between the axles [m].
        speed_mps: Forward speed [m/s].
        dt_s: Length of one tick [s].
        steering_limits_rad: Rightmost and leftmost steering angle [rad].
    """

    wheelbase_m: float
    speed_mps: float
    dt_s: float
    steering_limits_rad: tuple[float, float] = STEERING_LIMITS_RAD

    def __post_init__(self) -> None:
        _require_positive(wheelbase_m=self.wheelbase_m, speed_mps=self.speed_mps, dt_s=self.dt_s)
        _require_limits(self.steering_limits_rad)

    @property
    def state_size(self) -> int:
        """Number of states: x, y, yaw."""
        return 3

    def step(self, states: Tensor, controls: Tensor) -> Tensor:
        """One tick; see :class:`Dynamics`."""
        _check(states, controls, self.state_size)
        yaw_rate = self.speed_mps / self.wheelbase_m * torch.tan(controls.clamp(*self.steering_limits_rad))
        return _arc_step(states, yaw_rate, self.speed_mps, self.dt_s)

    def jacobians(self, states: Tensor, controls: Tensor) -> tuple[Tensor, Tensor]:
        """Closed form; see :class:`Dynamics`."""
        _check(states, controls, self.state_size)
        tangent = torch.tan(controls.clamp(*self.steering_limits_rad))
        gain = self.speed_mps / self.wheelbase_m
        df_dx, df_dyaw_rate = _arc_jacobians(states, gain * tangent, self.speed_mps, self.dt_s)
        dyaw_rate_du = gain * (1.0 + tangent**2) * _inside(controls, self.steering_limits_rad)
        return df_dx, df_dyaw_rate * dyaw_rate_du[:, None]


def _arc_step(states: Tensor, yaw_rate: Tensor, speed_mps: float, dt_s: float) -> Tensor:
    half = 0.5 * dt_s * yaw_rate
    chord = speed_mps * dt_s * _sinc(half)
    course = states[:, 2] + half
    return torch.stack(
        [states[:, 0] + chord * torch.cos(course), states[:, 1] + chord * torch.sin(course), course + half],
        dim=1,
    )


def _arc_jacobians(states: Tensor, yaw_rate: Tensor, speed_mps: float, dt_s: float) -> tuple[Tensor, Tensor]:
    half = 0.5 * dt_s * yaw_rate
    length = speed_mps * dt_s
    chord, chord_slope = length * _sinc(half), length * _sinc_slope(half)
    cosine, sine = torch.cos(states[:, 2] + half), torch.sin(states[:, 2] + half)
    df_dx = torch.eye(3, dtype=states.dtype, device=states.device).repeat(states.shape[0], 1, 1)
    df_dx[:, 0, 2] = -chord * sine
    df_dx[:, 1, 2] = chord * cosine
    df_dhalf = torch.stack(
        [
            chord_slope * cosine - chord * sine,
            chord_slope * sine + chord * cosine,
            torch.full_like(half, 2.0),
        ],
        dim=1,
    )
    return df_dx, df_dhalf * (0.5 * dt_s)


def _sinc(h: Tensor) -> Tensor:
    """``sin(h) / h``; the series is exact to 1e-16 below the switch and keeps autograd clean at zero."""
    small = h.abs() < 0.1
    h2 = h * h
    series = 1.0 - h2 / 6.0 * (1.0 - h2 / 20.0 * (1.0 - h2 / 42.0 * (1.0 - h2 / 72.0)))
    safe = torch.where(small, torch.ones_like(h), h)
    return torch.where(small, series, torch.sin(safe) / safe)


def _sinc_slope(h: Tensor) -> Tensor:
    """Derivative of ``sin(h) / h``."""
    small = h.abs() < 0.1
    h2 = h * h
    series = -h / 3.0 * (1.0 - h2 / 10.0 * (1.0 - h2 / 28.0 * (1.0 - h2 / 54.0)))
    safe = torch.where(small, torch.ones_like(h), h)
    return torch.where(small, series, (torch.cos(safe) - torch.sin(safe) / safe) / safe)


def _inside(controls: Tensor, limits: tuple[float, float]) -> Tensor:
    return ((controls >= limits[0]) & (controls <= limits[1])).to(controls.dtype)


def _check(states: Tensor, controls: Tensor, state_size: int) -> None:
    if states.ndim != 2 or states.shape[1] != state_size or controls.shape != states.shape[:1]:
        raise ValueError(
            f"expected states [B, {state_size}] and controls [B], got {list(states.shape)} and {list(controls.shape)}"
        )


def _require_positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0.0:
            raise ValueError(f"expected {name} > 0, got {value}")


def _require_limits(limits: tuple[float, float]) -> None:
    if not limits[0] < 0.0 < limits[1]:
        raise ValueError(f"expected steering limits (right < 0, left > 0) in rad, got {limits}")
