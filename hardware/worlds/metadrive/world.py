"""A road of MetaDrive as a world; its simulator is ``hardware/worlds/servers/metadrive.py`` in another process."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array
from hardware.worlds.fitting import fit_lines_and_arcs, path_through
from hardware.worlds.installed_world import InstalledWorld
from hardware.worlds.metadrive.config import MetaDriveConfig
from hardware.worlds.paths import ReferencePath
from hardware.worlds.world import Box, CarDescription, Traits, WorldDescription, WorldError

ROUTE = "route"
RANGE_M = (0.2, 1000.0)
_LOWEST_M = -0.1  # the grass lies a little under the road
_SPACING_M = 1.0  # between the route's poses
# The learned box extends this far beyond the driven stretch; lanes within this distance are described.
_BESIDE_M, _HIGH_M, _LOW_M = 25.0, 12.0, -0.5


class MetaDrive(InstalledWorld):
    """A road by block string and seed, with MetaDrive's renderer and its own car.

    The world's axes are those of MetaDrive's renderer: x along the first straight, z up, the middle of the road at y = 0. The body of the car is
    in no picture.
    """

    Config: ClassVar[type[MetaDriveConfig]] = MetaDriveConfig
    traits: ClassVar[Traits] = Traits(unseen=("car.own",), step_s=0.02)

    def __init__(self, config: MetaDriveConfig | None = None) -> None:
        self.config = MetaDriveConfig() if config is None else config
        super().__init__("metadrive", self.config, RANGE_M, _LOWEST_M)

    def description_of(self, facts: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> WorldDescription:
        """The driven stretch of the route, the lanes near it, and the box about it.

        Raises:
            WorldError: The route is shorter than the start of the stretch, or the lane ends within it.
        """
        road, car = self.config.road, self.config.car
        stretch = self._stretch(arrays["route"])
        path = self._path(stretch)
        lanes = [path_through(line) for line in _near(arrays["middles"], facts["middles"], stretch)]
        low, high = stretch[:, :2].min(axis=0) - _BESIDE_M, stretch[:, :2].max(axis=0) + _BESIDE_M
        return WorldDescription(
            paths={ROUTE: path},
            off_track_m=0.5 * road.lane_width_m,
            car=CarDescription(
                "ackermann",
                car.speed_mps,
                (-car.max_wheel_rad, car.max_wheel_rad),
                float(facts["wheelbase_m"]),
            ),
            camera=self.camera_pinhole,
            T_car_from_camera=self.T_car_from_camera,
            box=Box(
                (float(low[0]), float(low[1]), _LOW_M),
                (float(high[0]), float(high[1]), _HIGH_M),
                contraction=True,
            ),
            lanes=(path, *lanes),
            road_edge=tuple(_near(arrays["edges"], facts["edges"], stretch)),
            facts={"simulator": str(facts["simulator"])},
        )

    def _path(self, stretch: Array) -> ReferencePath:
        """The driven stretch as lines and arcs."""
        x, y, yaw = map(float, stretch[0])
        try:
            return ReferencePath((x, y, yaw), fit_lines_and_arcs(stretch))
        except ValueError as error:
            raise WorldError(
                f"expected a lane that goes on along the whole stretch; lane {self.config.road.lane} of the road {self.config.road.blocks!r} does not "
                f"({error}): name another one in road.lane, or end before with road.length_m"
            ) from error

    def _stretch(self, route: Array) -> Array:
        """Poses ``[N, 3]`` of the driven part of the route."""
        road = self.config.road
        first, last = round(road.from_m / _SPACING_M), round((road.from_m + road.length_m) / _SPACING_M)
        if len(route) < first + 11:
            raise WorldError(
                f"expected a route longer than road.from_m = {road.from_m:g} m by 10 m at least; the road {road.blocks!r} of seed {road.seed} has "
                f"{len(route)} m: add blocks, or begin earlier"
            )
        return np.asarray(route[first : last + 1], dtype=np.float64)


def _near(points: Array, counts: list[int], stretch: Array) -> list[Array]:
    """The lines ``[N, 2]`` of a concatenated array that come near the stretch."""
    found = []
    for line in np.split(np.asarray(points, dtype=np.float64), np.cumsum(counts)[:-1]):
        apart = np.linalg.norm(line[:, None] - stretch[None, :, :2], axis=2)
        if apart.min() < _BESIDE_M:
            found.append(line)
    return found
