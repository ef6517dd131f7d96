"""The deployed car's measured response from its drives without attack: speed, steering gain and offset, delay and lag. For predictions; it has no Jacobians.

During a tick of length T the last tick's command c' stays active for the delay d; then c = gain * control + offset. The
acting control follows it with a first-order lag tau: u(t) = c + (u(0) - c) exp(-t / tau). The car drives the tick with the mean of u.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from advnerf_core.driving.dynamics import Ackermann, Dubins
from advnerf_core.geometry import Array

_LONGEST_LAG_S, _SHORTEST_LAG_S = 1.0, 1e-4
# A drive that hardly steers does not determine the gain: it is then near one, and the offset near zero (standard deviations; of the limit).
_GAIN_SIGMA, _OFFSET_SIGMA, _YAW_SIGMA_RAD = 0.2, 0.05, 1e-3
_LAGS_S = (0.02, 0.15, 0.4)
_POSE, _ACTING, _BEFORE = 3, 3, 4


@dataclass(frozen=True)
class CarResponse:
    """Measured response of a car.

    Attributes:
        speed_mps: Speed of the car [m/s].
        gain: Steering per commanded steering.
        offset: Steering at command zero [rad, or rad/s].
        delay_s: Time until a command acts; at most one tick [s].
        lag_s: Time constant with which the steering follows [s].
    """

    speed_mps: float
    gain: float = 1.0
    offset: float = 0.0
    delay_s: float = 0.0
    lag_s: float = 0.0


class RespondingCar:
    """The surrogate's car with a measured response.

    Its state is the surrogate car's, the acting steering, and the last command: ``[x, y, yaw, u, c']``.

    Args:
        ideal: The surrogate's car; its speed is replaced by the measured one.
    """

    state_size = 5

    def __init__(self, ideal: Dubins | Ackermann, response: CarResponse) -> None:
        self._car = replace(ideal, speed_mps=response.speed_mps)
        self.response, self.dt_s = response, ideal.dt_s

    def start(self, poses: Tensor) -> Tensor:
        """States ``[B, 5]`` of cars at poses ``[B, 3]`` that go straight ahead."""
        return torch.cat([poses, poses.new_zeros(len(poses), self.state_size - _POSE)], dim=1)

    def step(self, states: Tensor, controls: Tensor) -> Tensor:
        """One tick from states ``[B, 5]`` with controls ``[B]``."""
        command = self.response.gain * controls + self.response.offset
        mean, acting = _follow(states[:, _ACTING], states[:, _BEFORE], command, self.response, self.dt_s)
        poses = self._car.step(states[:, :_POSE], mean)
        return torch.cat([poses, acting[:, None], command[:, None]], dim=1)


def fit_response(poses: Sequence[Array], controls: Sequence[Array], ideal: Dubins | Ackermann) -> CarResponse:
    """Fit the response of a car to drives.

    Args:
        poses: Poses ``[T + 1, 3]`` at the ticks of each drive; headings may wrap.
        controls: Commands ``[T]`` of each drive.

    Raises:
        ValueError: No drive has two ticks.
    """
    pairs = [
        (np.asarray(p, np.float64), np.asarray(c, np.float64))
        for p, c in zip(poses, controls, strict=True)
        if len(c) >= 2
    ]
    if not pairs:
        raise ValueError("expected drives of at least two ticks, got none; drive without attack first")
    steps = np.concatenate([np.hypot(*np.diff(p[:, :2], axis=0).T) for p, _ in pairs])
    turned = [np.diff(np.unwrap(p[:, 2])) for p, _ in pairs]
    # In the first ticks the car may still speed up.
    speed_mps = float(np.median(steps)) / ideal.dt_s
    limit = ideal.steering_limits_rad[1] if isinstance(ideal, Ackermann) else max(abs(pairs[0][1]).max(), 0.1)

    def response(values: Array) -> CarResponse:
        gain, offset, delay_s, lag_s = map(float, values)
        return CarResponse(speed_mps, gain, offset, delay_s, lag_s)

    def errors(values: Array) -> Array:
        answers = [_turns(c, response(values), ideal) - t for (_, c), t in zip(pairs, turned, strict=True)]
        prior = [(values[0] - 1.0) / _GAIN_SIGMA, values[1] / (_OFFSET_SIGMA * limit)]
        return np.concatenate([*answers, prior]) / np.r_[np.full(len(steps), _YAW_SIGMA_RAD), 1.0, 1.0]

    bounds = ([0.2, -limit, 0.0, 0.0], [3.0, limit, ideal.dt_s, _LONGEST_LAG_S])
    fits = [
        least_squares(errors, [1.0, 0.0, 0.3 * ideal.dt_s, lag_s], bounds=bounds, loss="soft_l1")
        for lag_s in _LAGS_S
    ]
    return response(min(fits, key=lambda fit: float(fit.cost)).x)


def _turns(controls: Array, response: CarResponse, ideal: Dubins | Ackermann) -> Array:
    """Heading by which the car turns in each tick [rad]."""
    acting, before = torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    means = []
    for control in controls:
        command = torch.tensor([response.gain * control + response.offset], dtype=torch.float64)
        mean, acting = _follow(acting, before, command, response, ideal.dt_s)
        before = command
        means.append(float(mean))
    if isinstance(ideal, Dubins):
        return ideal.dt_s * np.array(means)
    inside = np.clip(means, *ideal.steering_limits_rad)
    return np.asarray(response.speed_mps / ideal.wheelbase_m * np.tan(inside) * ideal.dt_s)


def _follow(
    acting: Tensor, before: Tensor, command: Tensor, response: CarResponse, dt_s: float
) -> tuple[Tensor, Tensor]:
    """Mean steering of a tick, and the steering at its end."""
    delay_s, lag_s = min(response.delay_s, dt_s), max(response.lag_s, _SHORTEST_LAG_S)
    total = torch.zeros_like(acting)
    for target, duration_s in ((before, delay_s), (command, dt_s - delay_s)):
        left = float(np.exp(-duration_s / lag_s))
        total = total + target * duration_s + (acting - target) * lag_s * (1.0 - left)
        acting = target + (acting - target) * left
    return total / dt_s, acting
