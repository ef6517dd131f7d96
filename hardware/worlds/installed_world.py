"""Common base of the third-party worlds that ``advnerf scene world install`` installs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.geometry import Array
from hardware.worlds.environments import ENVIRONMENTS
from hardware.worlds.remote_errors import ServerLost, SimulatorError
from hardware.worlds.remote_world import RemoteMeshWorld
from hardware.worlds.road_photos import road_photo_poses


class InstalledWorld(RemoteMeshWorld):
    """A remote world whose simulator runs in an environment of `ENVIRONMENTS`.

    Args:
        name: Name of the environment, and of the world in messages.
        config: The world's configuration, with ``camera``, ``photo`` and ``server``.
        range_m: See `RemoteWorld`.
        lowest_m: See `RemoteWorld`.
        unsent: Further keys of the configuration that the simulator does not know.
    """

    config: Any

    def __init__(
        self,
        name: str,
        config: Any,
        range_m: tuple[float, float],
        lowest_m: float,
        unsent: frozenset[str] = frozenset(),
    ) -> None:
        self._environment = ENVIRONMENTS[name]
        super().__init__(
            name,
            self._environment.simulator,
            config.model_dump(mode="json", exclude={"camera", "photo", "server", *unsent}),
            (config.camera.pinhole, config.photo.pinhole),
            config.camera.T_car_from_camera,
            range_m,
            lowest_m,
            config.server,
        )

    def python(self) -> Path:
        """The interpreter of the world's environment; see `RemoteWorld.python`."""
        return self._environment.python()

    def _open(self) -> None:
        try:
            super()._open()
        except (ServerLost, SimulatorError) as error:
            raise type(error)(
                f"{error}; expected these Debian packages, or what others call them: {' '.join(self._environment.system)}; install them, or see what the "
                "simulator said"
            ) from None

    def photo_poses(self, count: int, rng: np.random.Generator) -> list[Array]:
        """Poses along, beside and above the driven paths; see `road_photo_poses`."""
        description = self.describe()
        paths, lane_m = list(description.paths.values()), 2.0 * description.off_track_m
        return road_photo_poses(paths, lane_m, self.config.camera, count, rng)
