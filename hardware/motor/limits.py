"""Limits of the car, and the conversion of speed and steering to the units of its motor controller.

This is the lowest layer above the wire: no caller can send anything faster, sharper or more sudden than stated here.
The driver reports what it really sent, so a clipped command is visible in every recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

# A command after a pause may move the setpoints by no more than the slew limits allow in this time [s].
MAX_SLEW_STEP_S = 0.1


@dataclass(frozen=True)
class DriveLimits:
    """Limits of the car's commands.

    Attributes:
        speed_min_mps: Fastest reverse speed, <= 0 [m/s].
        speed_max_mps: Fastest forward speed [m/s].
        steering_min_rad: Rightmost front wheel angle, < 0 [rad].
        steering_max_rad: Leftmost front wheel angle [rad].
        acceleration_mps2: Largest increase of the magnitude of the speed setpoint [m/s^2]; slowing down is never delayed.
        steering_rate_radps: Largest change of the steering setpoint [rad/s].
        current_max_a: Largest magnitude of any commanded current [A].
    """

    speed_min_mps: float = -0.87
    speed_max_mps: float = 1.30
    steering_min_rad: float = -0.2634
    steering_max_rad: float = 0.3135
    acceleration_mps2: float = 3.5
    steering_rate_radps: float = 3.2
    current_max_a: float = 60.0

    def __post_init__(self) -> None:
        ordered = (
            self.speed_min_mps <= 0.0 < self.speed_max_mps
            and self.steering_min_rad < 0.0 < self.steering_max_rad
        )
        positive = (
            self.acceleration_mps2 > 0.0 and self.steering_rate_radps > 0.0 and self.current_max_a > 0.0
        )
        if not (ordered and positive):
            raise ValueError(
                f"expected limits around zero, positive rates and a positive current, got {self}"
            )


# A wheel of 0.4 m without a gear and one pole pair has 24, one of 0.02 m with a gear of 15 and seven pole pairs 50,000.
_LEAST_ERPM_PER_MPS, _MOST_ERPM_PER_MPS = 10.0, 1e5
_MOST_CREEP_MPS = 0.3


@dataclass(frozen=True)
class VehicleGains:
    """Affine maps between the car's motion and its motor controller, in the form of the RACECAR family.

    Attributes:
        erpm_per_mps: Electrical rpm per speed [1/(m/s)].
        erpm_offset: Electrical rpm at standstill.
        servo_per_rad: Servo units per front wheel angle [1/rad]; negative because a larger value turns right.
        servo_offset: Servo value that drives straight.
        servo_min: Smallest servo value the linkage allows.
        servo_max: Largest servo value the linkage allows.
    """

    erpm_per_mps: float = 4614.0
    erpm_offset: float = 0.0
    servo_per_rad: float = -1.2135
    servo_offset: float = 0.5304
    servo_min: float = 0.15
    servo_max: float = 0.85

    def __post_init__(self) -> None:
        if (
            self.erpm_per_mps == 0.0
            or self.servo_per_rad == 0.0
            or not 0.0 <= self.servo_min < self.servo_max <= 1.0
            or not self.servo_min <= self.servo_offset <= self.servo_max
        ):
            raise ValueError(
                f"expected gains that are not zero, servo limits in 0..1 and servo_offset between them, got {self}"
            )
        if not _LEAST_ERPM_PER_MPS <= abs(self.erpm_per_mps) <= _MOST_ERPM_PER_MPS:
            raise ValueError(
                f"expected erpm_per_mps from {_LEAST_ERPM_PER_MPS:g} to {_MOST_ERPM_PER_MPS:g} 1/(m/s) in magnitude, is it per km/h or per mm/s? Got {self}"
            )
        if abs(self.erpm_offset) > _MOST_CREEP_MPS * abs(self.erpm_per_mps):
            raise ValueError(
                f"expected an erpm_offset of at most {_MOST_CREEP_MPS:g} m/s, the wheels stand still at it; got {self}"
            )
        if (self.servo_max - self.servo_min) / abs(self.servo_per_rad) > math.pi:
            raise ValueError(
                f"expected servo_per_rad so that the servo turns the wheels by less than pi, is it per degree? Got {self}"
            )

    def erpm(self, speed_mps: float) -> float:
        """Electrical rpm for a speed."""
        return self.erpm_per_mps * speed_mps + self.erpm_offset

    def servo(self, steering_rad: float) -> float:
        """Servo value for a front wheel angle, inside the linkage's range."""
        return min(max(self.servo_per_rad * steering_rad + self.servo_offset, self.servo_min), self.servo_max)

    def speed_mps(self, erpm: float) -> float:
        """Speed at an electrical rpm [m/s]."""
        return (erpm - self.erpm_offset) / self.erpm_per_mps

    def steering_rad(self, servo: float) -> float:
        """Front wheel angle at a servo value [rad]."""
        return (servo - self.servo_offset) / self.servo_per_rad


@dataclass(frozen=True)
class Setpoint:
    """Speed [m/s] and steering [rad] inside all limits."""

    speed_mps: float
    steering_rad: float


@dataclass(frozen=True)
class Sent:
    """Commands really sent, after limits and the rounding of the protocol.

    Attributes:
        speed_mps: Speed of the sent rpm [m/s]; 0 when braking or coasting.
        steering_rad: Front wheel angle of the sent servo value [rad]; the last one when no servo was sent.
        erpm: Electrical rpm sent; 0 when braking or coasting.
        servo: Servo value sent, or the last one sent.
        brake_current_a: Brake current sent [A]; None if this was no brake command.
        write_mono_ns: Monotonic time just after the bytes were handed to the kernel [ns].
        write_real_ns: The same instant in real time [ns].
    """

    speed_mps: float
    steering_rad: float
    erpm: float
    servo: float
    brake_current_a: float | None
    write_mono_ns: int
    write_real_ns: int

    @property
    def braking(self) -> bool:
        """Whether this was a brake command."""
        return self.brake_current_a is not None


class DriveLimiter:
    """Keeps commands inside `DriveLimits`; it knows the last setpoint and therefore the next possible one."""

    def __init__(self, limits: DriveLimits) -> None:
        self.limits = limits
        self._last = Setpoint(0.0, 0.0)
        self._last_s: float | None = None

    @property
    def setpoint(self) -> Setpoint:
        """The last setpoint given out."""
        return self._last

    def apply(self, speed_mps: float, steering_rad: float, now_s: float) -> Setpoint | None:
        """Next setpoint toward a command at monotonic time ``now_s``; None if the command is not finite: stop."""
        if not (math.isfinite(speed_mps) and math.isfinite(steering_rad)):
            self.stop()
            return None
        limits = self.limits
        step_s = (
            MAX_SLEW_STEP_S if self._last_s is None else min(max(now_s - self._last_s, 0.0), MAX_SLEW_STEP_S)
        )
        speed = min(max(speed_mps, limits.speed_min_mps), limits.speed_max_mps)
        steering = min(max(steering_rad, limits.steering_min_rad), limits.steering_max_rad)
        self._last = Setpoint(
            self._slew_speed(speed, limits.acceleration_mps2 * step_s),
            _toward(self._last.steering_rad, steering, limits.steering_rate_radps * step_s),
        )
        self._last_s = now_s
        return self._last

    def steer(self, steering_rad: float) -> float:
        """Limit a steering angle for a standing car, without slew limit: nothing slips at standstill [rad]."""
        steering_rad = steering_rad if math.isfinite(steering_rad) else 0.0
        steering_rad = min(max(steering_rad, self.limits.steering_min_rad), self.limits.steering_max_rad)
        self._last = Setpoint(0.0, steering_rad)
        return steering_rad

    def current(self, current_a: float) -> float:
        """Limit a current [A]."""
        return min(max(current_a, -self.limits.current_max_a), self.limits.current_max_a)

    def stop(self) -> None:
        """Record a stop, so that the next speed starts from standstill."""
        self._last = replace(self._last, speed_mps=0.0)
        self._last_s = None

    def _slew_speed(self, speed_mps: float, step_mps: float) -> float:
        last = self._last.speed_mps
        # A reversal passes through zero: slowing down to it is free, speeding up beyond it is not.
        start = last if last * speed_mps > 0.0 else 0.0
        return speed_mps if abs(speed_mps) <= abs(start) else _toward(start, speed_mps, step_mps)


def _toward(start: float, goal: float, step: float) -> float:
    # Not by adding the difference: rounding may miss the goal by a last bit, and exceed a limit.
    return min(start + step, goal) if goal > start else max(start - step, goal)
