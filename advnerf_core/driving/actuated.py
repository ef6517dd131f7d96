"""A bicycle with slow, delayed steering: control delay, first-order servo lag and a limited steering rate.

The state is ``x, y, yaw, wheel angle, c_1 .. c_m``: the last ``m`` commands, youngest first, where ``m`` is the delay in ticks rounded
up. A delay of ``(k + f)`` ticks lets command ``c_{k+1}`` act for the first share ``f`` of a tick and ``c_k`` for the rest (``c_0`` is the
current control). While a command ``c`` acts, the wheel angle ``d`` follows ``dd/dt = clip((c - d) / lag, -slew, slew)``, which has
a closed form: with the error ``a = |d - c|`` the wheels move at the limit until ``a = slew * lag``, then the error decays
exponentially. Each part of the tick is driven as an arc with the mean wheel angle of that part.

Everything that a Jacobian needs is in state and control, so adjoint states follow without a render.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import torch
from torch import Tensor

from advnerf_core.driving.dynamics import (
    STEERING_LIMITS_RAD,
    _arc_jacobians,
    _arc_step,
    _check,
    _inside,
    _require_limits,
    _require_positive,
)

# A delay this close to whole ticks has no fraction: 0.3 / 0.1 is not 3 in binary.
_WHOLE_TICK = 1e-9
_POSE, _WHEEL, _PAST = 3, 3, 4


@dataclass(frozen=True)
class ActuatedAckermann:
    """Kinematic bicycle at the rear axle with constant speed behind a late, slow servo; see the module's docstring.

    The control is the commanded steering angle [rad], left positive. Commands beyond the limits are clamped when they are given,
    with zero derivative there. Past commands before the start come from the start state; zero is straight ahead.

    Attributes:
        wheelbase_m: Distance between the axles [m].
        speed_mps: Forward speed [m/s].
        dt_s: Length of one tick [s].
        delay_s: Delay from the control to the servo, whole ticks and a fraction [s].
        lag_s: Time constant of the servo [s]; 0 follows at once.
        slew_radps: Fastest change of the wheel angle [rad/s]; None has no limit.
        steering_limits_rad: Rightmost and leftmost steering angle [rad].
    """

    wheelbase_m: float
    speed_mps: float
    dt_s: float
    delay_s: float = 0.0
    lag_s: float = 0.0
    slew_radps: float | None = None
    steering_limits_rad: tuple[float, float] = STEERING_LIMITS_RAD

    def __post_init__(self) -> None:
        _require_positive(wheelbase_m=self.wheelbase_m, speed_mps=self.speed_mps, dt_s=self.dt_s)
        _require_limits(self.steering_limits_rad)
        if not (0.0 <= self.delay_s < inf and 0.0 <= self.lag_s < inf):
            raise ValueError(f"expected a finite delay and lag >= 0 s, got {self.delay_s} and {self.lag_s}")
        if self.slew_radps is not None:
            _require_positive(slew_radps=self.slew_radps)

    @property
    def state_size(self) -> int:
        """Number of states: four (x, y, yaw, wheel angle) and the past commands that have not acted yet."""
        whole, fraction = self._delay()
        return _PAST + whole + (fraction > 0.0)

    def step(self, states: Tensor, controls: Tensor) -> Tensor:
        """One tick; see :class:`advnerf_core.driving.dynamics.Dynamics`."""
        _check(states, controls, self.state_size)
        commands = self._commands(states, controls)
        pose, wheel = states[:, :_POSE], states[:, _WHEEL]
        for age, duration_s in self._parts():
            mean, wheel, _ = self._follow(wheel, commands[:, age], duration_s)
            pose = _arc_step(pose, self._yaw_rate(mean), self.speed_mps, duration_s)
        return torch.cat([pose, wheel[:, None], commands[:, : self.state_size - _PAST]], dim=1)

    def jacobians(self, states: Tensor, controls: Tensor) -> tuple[Tensor, Tensor]:
        """Closed form; see :class:`advnerf_core.driving.dynamics.Dynamics`."""
        _check(states, controls, self.state_size)
        batch, size = states.shape
        past = size - _PAST
        commands = self._commands(states, controls)
        # Columns: derivatives with respect to x, y, yaw, wheel, c_0 (the clamped control), c_1 .. c_m.
        pose, wheel = states[:, :_POSE], states[:, _WHEEL]
        d_pose, d_wheel = states.new_zeros(batch, _POSE, size + 1), states.new_zeros(batch, size + 1)
        d_pose[:, :, :_POSE] = torch.eye(_POSE, dtype=states.dtype, device=states.device)
        d_wheel[:, _WHEEL] = 1.0
        for age, duration_s in self._parts():
            mean, end, slopes = self._follow(wheel, commands[:, age], duration_s)
            d_command = torch.zeros_like(d_wheel)
            d_command[:, _PAST + age] = 1.0
            d_mean, d_wheel = (s[:, None] * d_wheel + (1.0 - s)[:, None] * d_command for s in slopes)
            yaw_rate = self._yaw_rate(mean)
            dpose_dpose, dpose_dyaw_rate = _arc_jacobians(pose, yaw_rate, self.speed_mps, duration_s)
            dyaw_rate_dmean = self.speed_mps / self.wheelbase_m * (1.0 + torch.tan(mean) ** 2)
            d_pose = (
                dpose_dpose @ d_pose
                + dpose_dyaw_rate[:, :, None] * (dyaw_rate_dmean[:, None] * d_mean)[:, None]
            )
            pose, wheel = _arc_step(pose, yaw_rate, self.speed_mps, duration_s), end
        everything = states.new_zeros(batch, size, size + 1)
        everything[:, :_POSE], everything[:, _WHEEL] = d_pose, d_wheel
        for k in range(past):  # each command grows one tick older
            everything[:, _PAST + k, _PAST + k] = 1.0
        df_du = everything[:, :, _PAST] * _inside(controls, self.steering_limits_rad)[:, None]
        return torch.cat([everything[:, :, :_PAST], everything[:, :, _PAST + 1 :]], dim=2), df_du

    def _delay(self) -> tuple[int, float]:
        """The delay in whole ticks and a fraction of one."""
        ticks = self.delay_s / self.dt_s
        if abs(ticks - round(ticks)) <= _WHOLE_TICK:
            return round(ticks), 0.0
        return int(ticks), ticks - int(ticks)

    def _parts(self) -> list[tuple[int, float]]:
        """Commands that act in a tick, in order: the age of each in ticks, and its duration [s]."""
        whole, fraction = self._delay()
        if fraction == 0.0:
            return [(whole, self.dt_s)]
        return [(whole + 1, fraction * self.dt_s), (whole, (1.0 - fraction) * self.dt_s)]

    def _commands(self, states: Tensor, controls: Tensor) -> Tensor:
        """Commands ``[B, m + 1]`` by age, the current one first."""
        return torch.cat([controls.clamp(*self.steering_limits_rad)[:, None], states[:, _PAST:]], dim=1)

    def _yaw_rate(self, wheel: Tensor) -> Tensor:
        return self.speed_mps / self.wheelbase_m * torch.tan(wheel)

    def _follow(
        self, wheel: Tensor, command: Tensor, duration_s: float
    ) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
        """Response of the wheel angle to a constant command.

        Returns:
            Its mean over the duration, its end, and the derivatives of both with respect to the first wheel angle (those with
            respect to the command are one minus them).
        """
        error = wheel - command
        size = error.abs()
        limited_s, moved = torch.zeros_like(size), torch.zeros_like(size)
        if self.slew_radps is not None:
            limited_s = ((size - self.slew_radps * self.lag_s) / self.slew_radps).clamp(0.0, duration_s)
            moved = self.slew_radps * limited_s
        free_s = duration_s - limited_s
        # With no lag the limit ends where the error is zero; before that, the whole duration was limited.
        left = torch.exp(-free_s / self.lag_s) if self.lag_s > 0.0 else (free_s <= 0.0).to(size.dtype)
        held_s = limited_s + self.lag_s * (1.0 - left)
        # For a <= slew * lag nothing of this is limited; past it the formulas meet smoothly.
        end = (size - moved) * left
        mean = ((size - 0.5 * moved) * limited_s + (size - moved) * self.lag_s * (1.0 - left)) / duration_s
        sign = torch.sign(error)
        return command + sign * mean, command + sign * end, (held_s / duration_s, left)
