"""Every number of CARLA as a world: the server, the junction, the cameras and the car."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field

from advnerf_core.strict import LengthM, StrictModel
from hardware.worlds.junction.config import DubinsConfig
from hardware.worlds.lab.config import CameraConfig, PhotoConfig

_WHOLE_TICK_S = 1e-6


class ServerConfig(StrictModel):
    """Address of the server and its time limits. Results depend on the map only.

    Attributes:
        host: Host name of the server.
        port: First port; images use the next number unless the server is configured otherwise.
        timeout_s: Limit for connecting, for a call, and for a tick [s].
        load_timeout_s: Limit for loading a map [s].
        frame_timeout_s: Limit from the end of a tick to the arrival of its pictures [s].
        town: The map; None uses the one that is loaded.
        load_town: Load the map if another one is loaded; this removes everything in the world.
        take_over: Continue if the world is already synchronous: another client drives it, or was killed.
        allow_traffic: Continue if the world has other vehicles or walkers, which would be in the pictures.
    """

    host: str = Field(default="127.0.0.1", exclude=True)
    port: int = Field(default=2000, ge=1, le=65534, exclude=True)
    timeout_s: float = Field(default=20.0, gt=0.0, exclude=True)
    load_timeout_s: float = Field(default=180.0, gt=0.0, exclude=True)
    frame_timeout_s: float = Field(default=5.0, gt=0.0, exclude=True)
    town: str | None = "Town02"
    load_town: bool = Field(default=True, exclude=True)
    take_over: bool = Field(default=False, exclude=True)
    allow_traffic: bool = Field(default=False, exclude=True)


class JunctionConfig(StrictModel):
    """The junction, and how much road around it is used.

    Attributes:
        id: OpenDRIVE id; None selects the map's first flat junction of three roads that are long enough.
        choice: Index among the junction's sets of drives.
        approach_m: Distance of the drives' starts from the junction's middle [m].
        beyond_m: Length of the road after the junction that belongs to the reference paths [m].
        max_height_range_m: Largest height difference along the drives [m]; the car moves in a plane.
        reach_m: The world ends at plus and minus this in x and y of the scene's frame [m].
    """

    id: int | None = None
    choice: int = Field(default=0, ge=0)
    approach_m: float = Field(default=24.0, gt=0.0)
    beyond_m: float = Field(default=40.0, gt=0.0)
    max_height_range_m: float = Field(default=0.15, ge=0.0)
    reach_m: float = Field(default=60.0, gt=0.0)


class RenderConfig(StrictModel):
    """The server's rendering.

    Attributes:
        fixed_delta_s: Simulated time of one tick [s]; CARLA's physics wants no more than 0.1.
        weather: Name of a preset of ``carla.WeatherParameters``, its wind stilled; None leaves the weather alone.
        freeze_lights: Stop the traffic lights while the scene is open.
        settle_ticks: Extra ticks after a camera has jumped: exposure, anti-aliasing over time and texture streaming catch up.
        exposure: ``fixed`` pins both bounds of the automatic exposure to one value, so that a place has one colour; ``automatic``
            leaves it alone.
        exposure_bright: The fixed exposure; None uses the server's upper bound, which suits daylight.
        camera_attributes: Attributes of ``sensor.camera.rgb``; a name that the server does not have is an error.
    """

    fixed_delta_s: float = Field(default=0.1, gt=0.0, le=0.1)
    weather: str | None = "ClearNoon"
    freeze_lights: bool = True
    settle_ticks: int = Field(default=5, ge=0, le=100)
    exposure: Literal["fixed", "automatic"] = "fixed"
    exposure_bright: float | None = Field(default=None, gt=0.0)
    camera_attributes: dict[str, str] = Field(
        default_factory=lambda: dict.fromkeys(
            ("motion_blur_intensity", "lens_flare_intensity", "bloom_intensity"), "0.0"
        )
    )

    def whole_ticks(self, duration_s: float) -> int:
        """Ticks that a duration takes.

        Raises:
            ValueError: The duration is not a whole number of ticks.
        """
        ticks = round(duration_s / self.fixed_delta_s) if math.isfinite(duration_s) else -1
        if ticks < 0 or abs(ticks * self.fixed_delta_s - duration_s) > _WHOLE_TICK_S:
            raise ValueError(
                f"expected a duration of whole ticks of render.fixed_delta_s = {self.fixed_delta_s:g} s, got {duration_s:g} s"
            )
        return ticks


class BodyConfig(StrictModel):
    """The car that is shown in CARLA. It has no physics: it is placed at the pose of the experiment's Dubins car.

    Attributes:
        blueprint: Name of the vehicle blueprint; None shows no body.
        origin_ahead_m: The blueprint's origin, the middle of the body, ahead of the reference point that moves along the heading
            [m]; about half the wheelbase, so that the reference point is the rear axle.
        half_length_m: From the origin to the front bumper [m].
        half_width_m: Half of the width [m].
        solid: Labels of ``carla.CityObjectLabel`` that stop the car; empty lets it pass through everything.
    """

    blueprint: str | None = "vehicle.lincoln.mkz_2020"
    origin_ahead_m: LengthM = 1.4
    half_length_m: LengthM = Field(default=2.45, gt=0.0)
    half_width_m: LengthM = Field(default=0.9, gt=0.0)
    solid: tuple[str, ...] = (
        "Buildings",
        "Walls",
        "Fences",
        "Poles",
        "GuardRail",
        "TrafficLight",
        "TrafficSigns",
    )


class CarlaConfig(StrictModel):
    """CARLA as a world.

    Attributes:
        server: Server and map.
        junction: Junction of the map.
        render: Weather, lights and exposure.
        body: The body of the car.
        camera: Driving camera, relative to the car's reference point. The default sits over the bonnet, which it does not see.
        photo: Camera of the posed images.
        car: Dynamics of the car.
    """

    server: ServerConfig = ServerConfig()
    junction: JunctionConfig = JunctionConfig()
    render: RenderConfig = RenderConfig()
    body: BodyConfig = BodyConfig()
    camera: CameraConfig = CameraConfig(x_m=3.2, z_m=1.6, pitch_down_rad=math.radians(8.0))
    photo: PhotoConfig = PhotoConfig()
    car: DubinsConfig = DubinsConfig()
