"""The car of the intersection: a Dubins car whose turn rate lags behind its command and has a gain error."""

from __future__ import annotations

import math
from collections.abc import Callable

from advnerf_core.geometry import VehicleState
from hardware.worlds.junction.config import DubinsConfig

# 3 cm at 6 m/s, 1/24 of the lag; between substeps the turn rate's mean is integrated exactly.
SUBSTEP_S = 0.005


class DubinsCar:
    """Moves at the commanded speed and turns at a bounded, lagging rate.

    ``x' = v cos(yaw)``, ``y' = v sin(yaw)``, ``yaw' = w``, and ``w' = (gain u - w) / lag``, or ``w = gain u`` with no lag.

    Args:
        fits: Whether the car may stand at x [m], y [m], yaw [rad]; the car stops before a pose where it may not.
    """

    def __init__(self, config: DubinsConfig, fits: Callable[[float, float, float], bool]) -> None:
        self.config = config
        self._fits = fits
        self.reset(0.0, 0.0, 0.0)

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> VehicleState:
        """Put the car down, at rest and turning nowhere."""
        if not all(map(math.isfinite, (x_m, y_m, yaw_rad))):
            raise ValueError(f"expected a finite pose, got {x_m}, {y_m}, {yaw_rad}")
        self._pose = (float(x_m), float(y_m), math.remainder(yaw_rad, 2.0 * math.pi))
        self._speed_mps = 0.0
        self.turn_rate_radps = 0.0
        self.blocked = not self._fits(*self._pose)
        return self.state

    @property
    def state(self) -> VehicleState:
        """True pose and speed; a Dubins car has no wheel angle."""
        return VehicleState(*self._pose, self._speed_mps)

    def advance(self, turn_rate_radps: float, speed_mps: float, duration_s: float) -> VehicleState:
        """Hold one command for a while.

        Args:
            turn_rate_radps: Commanded turn rate, left positive [rad/s]; clipped to the car's bound.
            speed_mps: Speed, reached at once [m/s].
            duration_s: Duration [s].

        Raises:
            ValueError: A value is not finite, or the duration is negative.
        """
        if not all(map(math.isfinite, (turn_rate_radps, speed_mps, duration_s))) or duration_s < 0.0:
            raise ValueError(
                f"expected a finite command and duration >= 0, got {turn_rate_radps}, {speed_mps}, {duration_s}"
            )
        bound = self.config.max_turn_rate_radps
        target = self.config.turn_rate_gain * min(max(turn_rate_radps, -bound), bound)
        count = math.ceil(duration_s / SUBSTEP_S - 1e-9)
        for _ in range(count):
            self._substep(target, speed_mps, duration_s / count)
        return self.state

    def _substep(self, target_radps: float, speed_mps: float, dt_s: float) -> None:
        lag, before = self.config.turn_rate_lag_s, self.turn_rate_radps
        if lag > 0.0:
            decay = math.exp(-dt_s / lag)
            # The lag's exact integral.
            turn = target_radps * dt_s + (before - target_radps) * lag * (1.0 - decay)
            self.turn_rate_radps = target_radps + (before - target_radps) * decay
        else:
            turn = target_radps * dt_s
            self.turn_rate_radps = target_radps
        # Chord of an arc: its direction is half-way through the turn.
        chord = speed_mps * dt_s * (math.sin(0.5 * turn) / (0.5 * turn) if abs(turn) > 1e-9 else 1.0)
        x, y, yaw = self._pose
        pose = (x + chord * math.cos(yaw + 0.5 * turn), y + chord * math.sin(yaw + 0.5 * turn), yaw + turn)
        self.blocked = not self._fits(*pose)
        if self.blocked:
            self._speed_mps = 0.0
            return
        self._pose = (pose[0], pose[1], math.remainder(pose[2], 2.0 * math.pi))
        self._speed_mps = speed_mps
