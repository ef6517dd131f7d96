"""Errors of a place where nothing can be driven or photographed: attacks are searched in its learned scene."""

from __future__ import annotations

from typing import Any, ClassVar, NoReturn

import numpy as np

from advnerf_core.geometry import Array, VehicleState
from hardware.worlds.world import Rgb, WorldError


class Undriven:
    """Driving part of a world that cannot drive."""

    known_by: ClassVar[str]

    @property
    def state(self) -> VehicleState:
        """Refuse, as there is no car."""
        self._refuse()

    @property
    def blocked(self) -> bool:
        """Refuse, as there is no car."""
        self._refuse()

    def photo_poses(self, count: int, rng: np.random.Generator) -> list[Array]:
        """Refuse, as no pictures can be taken."""
        del count, rng
        self._refuse()

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> VehicleState:
        """Refuse, as nothing is driven here."""
        del x_m, y_m, yaw_rad
        self._refuse()

    def step(self, control: float, speed_mps: float, duration_s: float) -> VehicleState:
        """Refuse, as nothing is driven here."""
        del control, speed_mps, duration_s
        self._refuse()

    def observe(self, depth: bool = True) -> Any:
        """Refuse, as nothing is driven here."""
        del depth
        self._refuse()

    def observe_at(self, x_m: float, y_m: float, yaw_rad: float, depth: bool = True) -> Any:
        """Refuse, as no other pictures can be taken."""
        del x_m, y_m, yaw_rad, depth
        self._refuse()

    def photograph(self, T_world_from_camera: Array) -> Rgb:
        """Refuse, as no other pictures can be taken."""
        del T_world_from_camera
        self._refuse()

    def _refuse(self) -> NoReturn:
        raise WorldError(
            f"expected a place that can be driven and photographed anew, got one that is known by {self.known_by} alone; attacks are searched "
            "in what is learned from it"
        )

    def __exit__(self, *raised: object) -> None:
        return
