"""The simulated car: a bicycle with servo slew and lag, a first-order motor, imperfect gains, and obstacles to hit.

The same class drives the synchronous lab and the VESC emulator, which is why it takes what a VESC takes: a servo position
and one motor mode (speed, duty, current or brake current).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from advnerf_core.geometry import VehicleState
from hardware.worlds.footprints import Footprint, touched_by
from hardware.worlds.lab.config import CarConfig

SUBSTEP_S = 0.004  # 3 mm at 0.8 m/s, and 1/15 of the fastest time constant


class TwinVehicle:
    """A car that obeys servo and motor commands as the real one does.

    Steering: the servo position is turned into a wheel angle by the *true* gain and offset; the angle follows it with a
    first-order lag whose rate is limited. Speed: see ``command``. Motion: rear-axle bicycle, exact arc in each substep.
    A step that would put the body into an obstacle or through a wall is not taken; the car stands there until it is
    commanded away from it. Two vehicles given the same commands and durations move identically to the bit.

    Args:
        params: Gains, lags and sizes.
        obstacles: Footprints the body cannot enter.
        room_half_m: The walls are at plus and minus this [m]; infinite without a room.
        start: Initial pose: x [m], y [m], yaw [rad].
    """

    def __init__(
        self,
        params: CarConfig,
        obstacles: Sequence[Footprint] = (),
        room_half_m: float = math.inf,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.params = params
        self._obstacles = tuple(obstacles)
        self._room_half_m = room_half_m
        self.reset(*start)

    def reset(self, x_m: float, y_m: float, yaw_rad: float, speed_mps: float = 0.0) -> None:
        """Put the car down with its wheels straight and its motor released (coasting if it moves)."""
        if not all(map(math.isfinite, (x_m, y_m, yaw_rad, speed_mps))):
            raise ValueError(f"expected a finite pose and speed, got {(x_m, y_m, yaw_rad, speed_mps)}")
        if not self.fits(x_m, y_m, yaw_rad):
            raise ValueError(
                f"expected a free place for the car, got ({x_m:.2f}, {y_m:.2f}, {yaw_rad:.2f} rad), which is inside a wall "
                "or an obstacle; choose a start pose on the track"
            )
        self._x, self._y, self._yaw, self._speed, self._steering = x_m, y_m, yaw_rad, speed_mps, 0.0
        self._servo = self.params.nominal_servo_offset
        self._mode, self._value = "current", 0.0
        self.odometer_m = 0.0
        self.blocked = False

    def command(
        self,
        *,
        servo: float | None = None,
        erpm: float | None = None,
        duty: float | None = None,
        current_a: float | None = None,
        brake_current_a: float | None = None,
    ) -> None:
        """Change the servo target, the motor mode, or both; None keeps the current value.

        Args:
            servo: Servo position 0..1, as the VESC's ``SET_SERVO_POS``.
            erpm: Closed-loop speed [electrical rpm]: first-order approach.
            duty: Only 0 is supported: the motor's phases are shorted, a drag stop.
            current_a: Motor current [A]; 0 coasts against friction.
            brake_current_a: Braking current [A]; friction plus a deceleration in proportion, never backwards.

        Raises:
            ValueError: A value is not finite, more than one motor mode is given, or ``duty`` is not 0.
        """
        modes = {"erpm": erpm, "duty": duty, "current": current_a, "brake": brake_current_a}
        given = {name: float(value) for name, value in modes.items() if value is not None}
        if len(given) > 1:
            raise ValueError(f"expected at most one motor mode, got {sorted(given)}")
        if not all(map(math.isfinite, [*given.values(), 0.0 if servo is None else servo])):
            raise ValueError(f"expected finite commands, got servo={servo}, {given}")
        if given.get("duty", 0.0) != 0.0:
            raise ValueError(f"expected duty 0 (drag stop), got {duty}; drive the twin by erpm or current")
        if servo is not None:
            self._servo = min(max(float(servo), 0.0), 1.0)
        for name, value in given.items():
            self._mode, self._value = name, value

    def advance(self, dt_s: float) -> VehicleState:
        """Move on by ``dt_s`` seconds in equal substeps of at most ``SUBSTEP_S``, and return the new state."""
        if not (math.isfinite(dt_s) and dt_s >= 0.0):
            raise ValueError(f"expected a finite duration >= 0 s, got {dt_s}")
        count = math.ceil(dt_s / SUBSTEP_S - 1e-9)
        for _ in range(count):
            self._substep(dt_s / count)
        return self.state

    @property
    def state(self) -> VehicleState:
        """True pose of the rear axle, speed and wheel angle."""
        return VehicleState(self._x, self._y, self._yaw, self._speed, self._steering)

    @property
    def erpm(self) -> float:
        """Electrical rpm that the motor controller measures."""
        return self._speed * self.params.true_erpm_gain

    def touches(self, x_m: float, y_m: float, yaw_rad: float) -> str:
        """Name of the obstacle that the body touches with the rear axle at this pose; empty if nothing is near."""
        return touched_by(self.body_at(x_m, y_m, yaw_rad), self._obstacles, self._room_half_m, "wall")

    def fits(self, x_m: float, y_m: float, yaw_rad: float) -> bool:
        """Whether the body is clear of walls and obstacles with the rear axle at this pose."""
        return not self._blocked(x_m, y_m, yaw_rad)

    def _substep(self, dt_s: float) -> None:
        p = self.params
        target = (self._servo - p.true_servo_offset) / p.true_servo_gain
        # The exact step of the lag, so that the result hardly depends on the substep.
        change = (target - self._steering) * -math.expm1(-dt_s / p.steering_lag_s)
        limit = p.steering_slew_radps * dt_s
        steering = self._steering + min(max(change, -limit), limit)
        speed = self._next_speed(dt_s)
        mean_speed = 0.5 * (self._speed + speed)
        turn = mean_speed * math.tan(0.5 * (self._steering + steering)) / p.wheelbase_m * dt_s
        # Chord of an exact arc: its direction is half-way through the turn.
        chord = mean_speed * dt_s * (math.sin(0.5 * turn) / (0.5 * turn) if abs(turn) > 1e-9 else 1.0)
        x = self._x + chord * math.cos(self._yaw + 0.5 * turn)
        y = self._y + chord * math.sin(self._yaw + 0.5 * turn)
        yaw = self._yaw + turn
        self._steering = steering
        self.blocked = mean_speed != 0.0 and self._blocked(x, y, yaw)
        if self.blocked:
            self._speed = 0.0
            return
        self._x, self._y, self._yaw, self._speed = x, y, math.remainder(yaw, 2.0 * math.pi), speed
        self.odometer_m += mean_speed * dt_s

    def _next_speed(self, dt_s: float) -> float:
        p, v = self.params, self._speed
        limit = p.grip_mps2 * dt_s
        if self._mode == "erpm":
            change = (self._value / p.true_erpm_gain - v) * -math.expm1(-dt_s / p.motor_lag_s)
            return v + min(max(change, -limit), limit)
        if self._mode == "current":
            push = p.acceleration_per_amp_mps2 * self._value * dt_s
            v += min(max(push, -limit), limit)
            return _towards_zero(v, p.friction_mps2 * dt_s)
        if self._mode == "brake":
            deceleration = p.friction_mps2 + p.acceleration_per_amp_mps2 * abs(self._value)
            return _towards_zero(v, min(deceleration * dt_s, limit))
        drag = abs(v) * -math.expm1(-dt_s / p.drag_stop_lag_s) + p.friction_mps2 * dt_s
        return _towards_zero(v, min(drag, limit))

    def body_at(self, x_m: float, y_m: float, yaw_rad: float) -> Footprint:
        """The body at a pose of the rear axle."""
        p = self.params
        ahead = 0.5 * p.wheelbase_m
        x, y = x_m + ahead * math.cos(yaw_rad), y_m + ahead * math.sin(yaw_rad)
        return Footprint(x, y, 0.5 * p.body_length_m, 0.5 * p.body_width_m, yaw_rad)

    def _blocked(self, x_m: float, y_m: float, yaw_rad: float) -> bool:
        body = self.body_at(x_m, y_m, yaw_rad)
        # Cheap test first: in the middle of the room no corner can reach a wall.
        if max(
            abs(body.x_m), abs(body.y_m)
        ) + body.half_length_m + body.half_width_m > self._room_half_m and any(
            max(abs(x), abs(y)) > self._room_half_m for x, y in body.corners()
        ):
            return True
        return any(body.overlaps(obstacle) for obstacle in self._obstacles)


def _towards_zero(value: float, amount: float) -> float:
    """Reduce a magnitude by ``amount`` without changing its sign."""
    return math.copysign(max(abs(value) - amount, 0.0), value)
