"""Dead reckoning of a car from its motor controller's measured speed and commanded servo position: a bicycle, exact arc by arc.

The servo has no read-back, so the steering is the commanded one; after ``vesc_to_odom`` of the MIT RACECAR stack, whose explicit
Euler step is replaced by the arc, and whose covariances are kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

# Longest pause that is integrated, because the motion during longer pauses is unknown [s].
LONGEST_STEP_S = 0.2
# Variances of x, y [m^2] and yaw [rad^2], as in the RACECAR stack.
POSITION_VARIANCE, YAW_VARIANCE = 0.2, 0.4


@dataclass(frozen=True)
class OdometryState:
    """Pose and speed of the car by dead reckoning.

    Attributes:
        x_m: Position of the rear axle since the start [m].
        y_m: Position of the rear axle since the start [m].
        yaw_rad: Heading since the start, in -pi..pi [rad].
        speed_mps: Speed [m/s].
        yaw_rate_radps: Yaw rate [rad/s].
    """

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    speed_mps: float = 0.0
    yaw_rate_radps: float = 0.0


class Odometry:
    """Integrates speed and steering.

    Args:
        wheelbase_m: Distance between the axles [m].
    """

    def __init__(self, wheelbase_m: float) -> None:
        if not wheelbase_m > 0.0:
            raise ValueError(f"expected a wheelbase above 0 m, got {wheelbase_m}")
        self._wheelbase_m = wheelbase_m
        self._last_ns: int | None = None
        self.state = OdometryState()

    def update(self, speed_mps: float, steering_rad: float, mono_ns: int) -> OdometryState:
        """Update with speed [m/s] and front wheel angle [rad] since the last update, measured now [ns]."""
        if not (math.isfinite(speed_mps) and math.isfinite(steering_rad)):
            return self.state
        step_s = (
            0.0 if self._last_ns is None else min(max((mono_ns - self._last_ns) / 1e9, 0.0), LONGEST_STEP_S)
        )
        self._last_ns = mono_ns
        rate = speed_mps * math.tan(steering_rad) / self._wheelbase_m
        half = 0.5 * rate * step_s
        chord = speed_mps * step_s * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        old = self.state
        self.state = OdometryState(
            old.x_m + chord * math.cos(old.yaw_rad + half),
            old.y_m + chord * math.sin(old.yaw_rad + half),
            math.remainder(old.yaw_rad + 2.0 * half, 2.0 * math.pi),
            speed_mps,
            rate,
        )
        return self.state
