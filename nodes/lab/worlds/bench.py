"""Common parts of all checks of a world: the open world, its description, and poses to look from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from advnerf_core.geometry import Array, VehicleState
from hardware.worlds.paths import Pose, ReferencePath
from hardware.worlds.world import World, WorldDescription
from nodes.lab.worlds.named import NamedWorld

TICK_S = 0.1
# Stretch of a path that is driven and inspected [s].
DRIVEN_S = 6.0


@dataclass(frozen=True)
class WorldBench:
    """An open world under test.

    Attributes:
        step_s: A step's duration must be a multiple of this [s]; None for any duration.
    """

    named: NamedWorld
    world: World
    description: WorldDescription
    step_s: float | None

    @cached_property
    def tick_s(self) -> float:
        """A control tick that the world supports, near 0.1 s [s]."""
        return TICK_S if self.step_s is None else max(round(TICK_S / self.step_s), 1) * self.step_s

    def driven_m(self, path: ReferencePath) -> float:
        """Length of a path that a check drives [m]."""
        length_m = path.length_m
        return min(self.description.car.speed_mps * DRIVEN_S, length_m if path.closed else 0.95 * length_m)

    @cached_property
    def places(self) -> list[Pose]:
        """Poses of the car on the paths: at each start, and after a third and two thirds of the driven length."""
        return [
            path.pose_at(share * self.driven_m(path))
            for path in self.description.paths.values()
            for share in (0.0, 1.0 / 3.0, 2.0 / 3.0)
        ]

    def beside(self, place: Pose, ahead_m: float, left_m: float, turn_rad: float) -> Pose:
        """A pose of the car near another one, in the axes of that one."""
        x, y, yaw = place
        c, s = np.cos(yaw), np.sin(yaw)
        return float(x + c * ahead_m - s * left_m), float(y + s * ahead_m + c * left_m), float(yaw + turn_rad)


Check = Callable[[WorldBench], str]
"""Looks at one part of the contract: gives what was found, or raises `NotMet` or `MetButLook`."""


def pose_of(state: VehicleState) -> Array:
    """x [m], y [m], yaw [rad] of a state ``[3]``."""
    return np.array([state.x_m, state.y_m, state.yaw_rad])
