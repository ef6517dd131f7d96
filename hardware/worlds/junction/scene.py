"""The simulated intersection, synchronous: observe, decide, step, as fast as it goes. Time passes only in ``step``."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from advnerf_core.geometry import Array, Pinhole, VehicleState, look_at
from hardware.worlds.footprints import Footprint, touched_by
from hardware.worlds.junction.car import DubinsCar
from hardware.worlds.junction.config import UNSEEN_OF_A_CAR, IntersectionConfig
from hardware.worlds.junction.ground import kerb_lines
from hardware.worlds.junction.photos import photo_poses
from hardware.worlds.junction.town import obstacles
from hardware.worlds.junction.world import build_model
from hardware.worlds.lab.renderer import Renderer
from hardware.worlds.seen import SeenWorld
from hardware.worlds.world import Box, NotOpenError, Rgb, Traits, View, WorldDescription

RANGE_M = (0.1, 250.0)  # from the near plane to past the farthest corner of the sky


class Intersection(SeenWorld):
    """A junction of three roads with a Dubins car in it; a `hardware.worlds.world.World`.

    The same configuration and the same calls give the same bytes on one machine. While it is open it owns an OpenGL context: use it in the
    thread that opened it.

    Args:
        config: All numbers of the scene.

    Raises:
        TwinUnavailable: When it is opened, MuJoCo or EGL is missing; the message names the packages.
    """

    Config: ClassVar[type[IntersectionConfig]] = IntersectionConfig
    traits: ClassVar[Traits] = Traits(unseen=UNSEEN_OF_A_CAR)

    def __init__(self, config: IntersectionConfig | None = None) -> None:
        self.config = IntersectionConfig() if config is None else config
        self.camera_pinhole: Pinhole = self.config.camera.pinhole
        self.photo_pinhole: Pinhole = self.config.photo.pinhole
        self.T_car_from_camera: Array = self.config.camera.T_car_from_camera
        self._obstacles = obstacles(self.config)
        self._car = DubinsCar(self.config.car, self.fits)
        self._renderer: Renderer | None = None

    def describe(self) -> WorldDescription:
        """The drives, and all lanes, which together cover the asphalt. The box holds the painted sky: nothing lies outside."""
        config, road = self.config, self.config.road
        return WorldDescription(
            paths={str(name): path for name, path in config.paths().items()},
            off_track_m=config.off_track_m,
            car=config.car.description,
            camera=self.camera_pinhole,
            T_car_from_camera=self.T_car_from_camera,
            box=Box((-road.half_m, -road.half_m, 0.0), (road.half_m, road.half_m, road.sky_m)),
            lanes=config.lanes(),
            road_edge=tuple(kerb_lines(road, 0.0).values()),
        )

    def photo_poses(self, count: int, rng: np.random.Generator) -> list[Array]:
        """Poses ``T_world_from_camera [4, 4]`` along, beside and above the drives; see `hardware.worlds.junction.photos`."""
        return photo_poses(self.config, count, rng)

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> VehicleState:
        """Put the car down at rest, turning nowhere."""
        return self._car.reset(x_m, y_m, yaw_rad)

    def step(self, turn_rate_radps: float, speed_mps: float, duration_s: float) -> VehicleState:
        """Hold one command for a while.

        Args:
            turn_rate_radps: Commanded turn rate, left positive [rad/s]; clipped to the car's bound.
            speed_mps: Speed, reached at once [m/s].
            duration_s: Time to the next observation [s].
        """
        return self._car.advance(turn_rate_radps, speed_mps, duration_s)

    @property
    def state(self) -> VehicleState:
        """True state of the car."""
        return self._car.state

    @property
    def blocked(self) -> bool:
        """Whether the car stands against a house, a trunk or a post, or at the end of the world."""
        return self._car.blocked

    def fits(self, x_m: float, y_m: float, yaw_rad: float) -> bool:
        """Whether the car's body is clear of everything solid at a pose of its reference point."""
        body = self._body(x_m, y_m, yaw_rad)
        if any(max(map(abs, corner)) > self.config.road.half_m for corner in body.corners()):
            return False
        return not any(body.overlaps(obstacle) for obstacle in self._obstacles)

    def touches(self, x_m: float, y_m: float, yaw_rad: float) -> str:
        """Name of what the car stands against at a pose; see `hardware.worlds.world.NamesObstacles`."""
        body, half_m = self._body(x_m, y_m, yaw_rad), self.config.road.half_m
        return touched_by(body, self._obstacles, half_m, "end of the world")

    @property
    def car_body(self) -> Footprint:
        """The car's body around its reference point; see `hardware.worlds.world.HasSolids`."""
        return self._body(0.0, 0.0, 0.0)

    @property
    def solids(self) -> list[Footprint]:
        """Houses, trunks, hedges, boxes and posts; the attacked objects are not part of the world."""
        return list(self._obstacles)

    def _body(self, x_m: float, y_m: float, yaw_rad: float) -> Footprint:
        car = self.config.car
        x, y = x_m + car.body_ahead_m * np.cos(yaw_rad), y_m + car.body_ahead_m * np.sin(yaw_rad)
        return Footprint(float(x), float(y), 0.5 * car.body_length_m, 0.5 * car.body_width_m, yaw_rad)

    def photograph(self, T_world_from_camera: Array) -> Rgb:
        """A photograph ``[H, W, 3]`` uint8 with ``photo_pinhole``, in the driving camera's colours."""
        return self._open_renderer().render_rgb(T_world_from_camera, self.photo_pinhole)

    def overview(self, width: int = 960, height: int = 720) -> tuple[Rgb, Pinhole, Array]:
        """The junction from above the south, and the camera of this view: intrinsics and ``T_world_from_camera`` ``[4, 4]``."""
        focal = 1.0 * width
        pinhole = Pinhole(width, height, focal, focal, 0.5 * width, 0.5 * height)
        T = look_at([0.0, -46.0, 62.0], [0.0, -7.0, 0.0])
        return self._open_renderer().render_rgb(T, pinhole), pinhole, T  # the sky is seen from inside only

    def close(self) -> None:
        """Free the OpenGL context; safe to call twice."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __enter__(self) -> Intersection:
        if self._renderer is None:
            self._renderer = Renderer(build_model(self.config), self.config.supersampling, range_m=RANGE_M)
        return self

    def _open_renderer(self) -> Renderer:
        if self._renderer is None:
            raise NotOpenError(
                "expected the junction to be open for a picture; it is closed: use it as a context manager"
            )
        return self._renderer

    def _see(self, T_world_from_car: Array, depth: bool) -> View:
        renderer, T = self._open_renderer(), T_world_from_car @ self.T_car_from_camera
        rgb = renderer.render_rgb(T, self.camera_pinhole)
        return rgb, renderer.render_depth(T, self.camera_pinhole) if depth else None
