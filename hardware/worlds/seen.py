"""Common base of worlds whose cameras see the place from any pose."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType

from advnerf_core.geometry import Array, VehicleState, planar_pose
from hardware.worlds.world import View


class SeenWorld(ABC):
    """A world whose driving camera sees from any pose of the car, the current one and others."""

    @property
    @abstractmethod
    def state(self) -> VehicleState:
        """True state of the car."""

    def observe(self, depth: bool = True) -> View:
        """View of the driving camera: colours ``[H, W, 3]`` and planar depth ``[H, W]`` [m], or None if not wanted."""
        return self._see(self.state.T_world_from_car, depth)

    def observe_at(self, x_m: float, y_m: float, yaw_rad: float, depth: bool = True) -> View:
        """The driving camera's view from another pose of the car (see :meth:`observe`); the car does not move."""
        return self._see(planar_pose(x_m, y_m, yaw_rad), depth)

    @abstractmethod
    def close(self) -> None:
        """Free what was opened; safe to call twice."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @abstractmethod
    def _see(self, T_world_from_car: Array, depth: bool) -> View:
        """Picture and depth from a pose ``[4, 4]`` of the car."""
