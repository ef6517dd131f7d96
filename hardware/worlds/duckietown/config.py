"""Every number of Duckietown as a world: the map, the cameras, the robot."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field

from advnerf_core.strict import StrictModel
from hardware.worlds.lab.config import CameraConfig, PhotoConfig
from hardware.worlds.remote_world import ServerDeadlines


class RobotConfig(StrictModel):
    """The differential drive: Duckietown's nominal motors, which answer 0.15 s late.

    Attributes:
        speed_mps: Speed of the experiments [m/s].
        max_turn_rate_radps: Largest commanded turn rate [rad/s]; at 0.25 m/s the motors reach 4.3.
    """

    speed_mps: float = Field(default=0.25, gt=0.0, le=0.5)
    max_turn_rate_radps: float = Field(default=3.6, gt=0.0, le=4.3)


class StretchConfig(StrictModel):
    """The driven part of one closed route, instead of all routes: photographs and learned box keep to it.

    Attributes:
        route: Name of the route.
        from_m: Start of the stretch and of the drives along it [m].
        length_m: Length of the stretch [m].
    """

    route: str = "right"
    from_m: float = Field(default=0.0, ge=0.0)
    length_m: float = Field(default=3.0, gt=0.5)


class DuckietownConfig(StrictModel):
    """The whole world.

    Attributes:
        map_name: Name of a Duckietown map with a closed route.
        seed: Seed of everything that the map leaves open.
        drives_from_m: Start of the drives along each closed route, in its direction [m].
        stretch: The only path, an open part of one route; None: all closed routes.
        camera: Driving camera, mounted relative to the middle of the axle; the default is the robot's own.
        photo: Camera of the posed images that a surrogate is learned from.
        robot: The car.
        supersampling: Every pixel is the mean of this number squared.
        server: Deadlines of its process.
    """

    map_name: str = Field(default="small_loop", min_length=1, pattern=r"^[\w-]+$")
    seed: int = Field(default=3, ge=0)
    drives_from_m: float = Field(default=0.0, ge=0.0)
    stretch: StretchConfig | None = None
    camera: CameraConfig = CameraConfig(
        x_m=0.066, z_m=0.108, pitch_down_rad=math.radians(19.15), horizontal_fov_deg=107.8
    )
    photo: PhotoConfig = PhotoConfig(horizontal_fov_deg=110.0)
    robot: RobotConfig = RobotConfig()
    supersampling: Literal[1, 3] = 3
    server: ServerDeadlines = Field(default=ServerDeadlines(), exclude=True)
