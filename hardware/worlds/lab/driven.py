"""The lab's car with delayed commands: the dynamics of the synchronous lab, independent of the renderer."""

from __future__ import annotations

import numpy as np

from advnerf_core.geometry import VehicleState
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.furniture import vehicle_in_room


class DrivenCar:
    """The car among the room's furniture, commanded like the real car. Two cars with the same calls move identically to the bit.

    Attributes:
        time_s: Lab time since the last reset [s].
    """

    def __init__(self, config: LabConfig) -> None:
        self._params, self._vehicle = config.car, vehicle_in_room(config)
        self._pending: list[tuple[float, float, float]] = []  # due time [s], servo, erpm
        self.time_s = 0.0

    @property
    def state(self) -> VehicleState:
        """True state of the car."""
        return self._vehicle.state

    @property
    def blocked(self) -> bool:
        """Whether the car stands against a wall or an obstacle."""
        return self._vehicle.blocked

    def reset(self, x_m: float, y_m: float, yaw_rad: float, speed_mps: float = 0.0) -> VehicleState:
        """Put the car down, forget commands under way and start lab time at 0; a speed, if given, is held."""
        self._vehicle.reset(x_m, y_m, yaw_rad, speed_mps)
        if speed_mps != 0.0:
            self._vehicle.command(erpm=self._vehicle.erpm)
        self._pending.clear()
        self.time_s = 0.0
        return self.state

    def step(self, steering_rad: float, speed_mps: float, duration_s: float) -> VehicleState:
        """Send one command and let time pass; see `hardware.worlds.lab.lab.Lab.step`."""
        if not np.isfinite([steering_rad, speed_mps, duration_s]).all() or duration_s < 0.0:
            raise ValueError(
                f"expected a finite command and duration >= 0, got {steering_rad}, {speed_mps}, {duration_s}"
            )
        car = self._params
        due = self.time_s + car.command_delay_s
        self._pending.append((due, car.servo_from_steering(steering_rad), car.erpm_from_speed(speed_mps)))
        end = self.time_s + duration_s
        while self._pending and self._pending[0][0] <= end:
            due, servo, erpm = self._pending.pop(0)
            self._vehicle.advance(max(due - self.time_s, 0.0))
            self.time_s = due
            self._actuate(servo, erpm)
        self._vehicle.advance(max(end - self.time_s, 0.0))
        self.time_s = end
        return self.state

    def _actuate(self, servo: float, erpm: float) -> None:
        if abs(erpm) < self._params.min_erpm:
            self._vehicle.command(servo=servo, duty=0.0)
        else:
            self._vehicle.command(servo=servo, erpm=erpm)
