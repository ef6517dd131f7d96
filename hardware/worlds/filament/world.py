"""The lab drawn by MuJoCo 4's Filament; the renderer is ``hardware/worlds/servers/filament.py`` in another process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, VehicleState, make_transform
from hardware.worlds.filament.config import FilamentConfig
from hardware.worlds.installed_world import InstalledWorld
from hardware.worlds.lab.driven import DrivenCar
from hardware.worlds.lab.files import room_as_files
from hardware.worlds.lab.lab import Lab
from hardware.worlds.lab.phone import apply_colours
from hardware.worlds.world import Panel, Rgb, Traits, View, WorldDescription, WorldError

RANGE_M = (0.02, 30.0)
MONITOR = "monitor"
_BEFORE_SCREEN_M = 0.002


class Filament(InstalledWorld):
    """The lab with another renderer: room, cameras and car are those of `hardware.worlds.lab.lab.Lab`.

    The scene is composed here and sent as files. The car drives here too, by the same code, so that the same commands move it exactly as in the
    lab; the other process only draws. The car's own body is in no picture.
    """

    Config: ClassVar[type[FilamentConfig]] = FilamentConfig
    traits: ClassVar[Traits] = Traits(
        unseen=tuple(f"lab.{key}" for key in Lab.traits.unseen), own_photo_colours=True
    )

    def __init__(self, config: FilamentConfig | None = None) -> None:
        self.config = FilamentConfig() if config is None else config
        super().__init__("filament", self.config, RANGE_M, 0.0)
        # Never opened: the lab's description needs no renderer.
        self._room = Lab(self.config.lab)
        self._car = DrivenCar(self.config.lab)

    def opened_with(self) -> Mapping[str, NDArray[Any]]:
        """The scene as files."""
        files = room_as_files(self.config.lab)
        return {name: np.frombuffer(data, np.uint8) for name, data in files.items()}

    def description_of(self, facts: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> WorldDescription:
        """The lab's description, and the renderer's name."""
        return replace(self._room.describe(), facts={"simulator": str(facts["simulator"])})

    def photo_poses(self, count: int, rng: np.random.Generator) -> list[Array]:
        """The lab's photo poses."""
        return self._room.photo_poses(count, rng)

    def touches(self, x_m: float, y_m: float, yaw_rad: float) -> str:
        """Name of what the car stands against at a pose; see `hardware.worlds.world.NamesObstacles`."""
        return self._room.touches(x_m, y_m, yaw_rad)

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> VehicleState:
        """Put the car down at rest; a process that was lost is started again."""
        self._require_open()
        if self.server is None:
            self._open()
        self._state = self._car.reset(x_m, y_m, yaw_rad)
        self._blocked = self._car.blocked
        return self._state

    def step(self, steering_rad: float, speed_mps: float, duration_s: float) -> VehicleState:
        """Send one command with the lab's delays and limits, and let time pass."""
        _ = self.state  # raises if the process was lost during this drive
        self._state = self._car.step(steering_rad, speed_mps, duration_s)
        self._blocked = self._car.blocked
        return self._state

    def observe(self, depth: bool = True) -> View:
        """View of the driving camera; right before it there may be furniture instead of the floor."""
        state = self.state
        return self.observe_at(state.x_m, state.y_m, state.yaw_rad, depth)

    def photograph(self, T_world_from_camera: Array) -> Rgb:
        """A photograph ``[H, W, 3]`` with the phone's lens and the phone's own colours."""
        return apply_colours(super().photograph(T_world_from_camera), self.config.lab.phone)

    def show(self, panel: str, rgb: Rgb | None) -> None:
        """Show a picture on the monitor, as a matte surface in the room's light.

        Raises:
            WorldError: The panel is no screen.
        """
        if panel != MONITOR:
            raise WorldError(f"expected a screen of the lab: {MONITOR}; got {panel!r}")
        screen = self.config.lab.monitor
        T = screen.T_world_from_face @ make_transform(np.eye(3), [_BEFORE_SCREEN_M, 0.0, 0.0])
        self.add_panel(MONITOR, Panel(T, screen.width_m, screen.height_m), rgb)
