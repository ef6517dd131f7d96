"""A map of Duckietown as a world; its simulator is ``hardware/worlds/servers/duckietown.py`` in another process."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array
from hardware.worlds.duckietown.config import DuckietownConfig
from hardware.worlds.fitting import path_through
from hardware.worlds.installed_world import InstalledWorld
from hardware.worlds.paths import ReferencePath
from hardware.worlds.world import Box, CarDescription, Traits, WorldDescription, WorldError

RANGE_M = (0.04, 100.0)
# A lane's middle is at this share of a tile from the middle of the road; half a lane is as wide.
_HALF_LANE_TILES = 0.2
_FIT_M = 0.004  # half a lane is 0.12 m
_LOWEST_M, _LOW_M, _HIGH_M, _BESIDE_M = -0.1, -0.05, 0.6, 0.3


class Duckietown(InstalledWorld):
    """A map of Duckietown with its own renderer and its differential drive.

    Its paths are the closed routes along the lanes' middles, named by direction: ``left`` (counter-clockwise from above) and ``right``. The
    world's x is Duckietown's, its y is Duckietown's -z, and z points up. The robot is in no picture.
    """

    Config: ClassVar[type[DuckietownConfig]] = DuckietownConfig
    traits: ClassVar[Traits] = Traits(step_s=0.02)

    def __init__(self, config: DuckietownConfig | None = None) -> None:
        self.config = DuckietownConfig() if config is None else config
        super().__init__(
            "duckietown", self.config, RANGE_M, _LOWEST_M, frozenset({"robot", "drives_from_m", "stretch"})
        )

    def description_of(self, facts: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> WorldDescription:
        """The closed routes of the map, or the stretch of one, and the box about them.

        Raises:
            WorldError: The map has no closed route, or not the one of the stretch.
        """
        if not facts["ways"]:
            raise WorldError(
                f"expected a map of Duckietown with a way round; {self.config.map_name} has none: name another one, such as small_loop"
            )
        lines = np.split(np.asarray(arrays["ways"], dtype=np.float64), np.cumsum(facts["ways"])[:-1])
        robot, (width_m, depth_m) = self.config.robot, facts["size_m"]
        limit = robot.max_turn_rate_radps
        (low_x_m, low_y_m), (high_x_m, high_y_m) = (0.0, -float(depth_m)), (float(width_m), 0.0)
        paths = self._driven(_named(lines))
        if self.config.stretch is not None:
            (path,) = paths.values()
            along = np.array([path.pose_at(s_m)[:2] for s_m in np.linspace(0.0, path.length_m, 100)])
            low_x_m, low_y_m, high_x_m, high_y_m = map(float, (*along.min(axis=0), *along.max(axis=0)))
        return WorldDescription(
            paths=paths,
            off_track_m=_HALF_LANE_TILES * float(facts["tile_m"]),
            car=CarDescription("dubins", robot.speed_mps, (-limit, limit)),
            camera=self.camera_pinhole,
            T_car_from_camera=self.T_car_from_camera,
            box=Box(
                (low_x_m - _BESIDE_M, low_y_m - _BESIDE_M, _LOW_M),
                (high_x_m + _BESIDE_M, high_y_m + _BESIDE_M, _HIGH_M),
                contraction=True,
            ),
            facts={"simulator": str(facts["simulator"])},
        )

    def _driven(self, routes: dict[str, ReferencePath]) -> dict[str, ReferencePath]:
        """The routes, with the start of their drives as configured, or the stretch of one."""
        begin_m, stretch = self.config.drives_from_m, self.config.stretch
        if stretch is None:
            return {
                name: replace(path, drive_from=path.pose_at(begin_m)) if begin_m else path
                for name, path in routes.items()
            }
        if stretch.route not in routes:
            raise WorldError(
                f"expected stretch.route to be one of {', '.join(routes)} of {self.config.map_name}, got {stretch.route}"
            )
        return {stretch.route: routes[stretch.route].stretch(stretch.from_m, stretch.length_m)}


def _named(lines: list[Array]) -> dict[str, ReferencePath]:
    """The routes by name, each with a one-hot goal; the longest route in each direction gets the direction's name."""
    areas = [
        0.5 * float(np.sum(line[:, 0] * np.roll(line[:, 1], -1) - line[:, 1] * np.roll(line[:, 0], -1)))
        for line in lines
    ]
    ranked = sorted(range(len(lines)), key=lambda index: -abs(areas[index]))
    paths: dict[str, ReferencePath] = {}
    for index in ranked:
        side = "left" if areas[index] > 0.0 else "right"
        taken = sum(name.startswith(side) for name in paths)
        goal = tuple(float(len(paths) == other) for other in range(len(lines)))
        paths[f"{side}{taken + 1}" if taken else side] = path_through(
            lines[index], goal, closed=True, tolerance_m=_FIT_M
        )
    return paths
