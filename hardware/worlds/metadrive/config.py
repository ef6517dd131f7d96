"""Every number of MetaDrive as a world: the road, the cameras, the car."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field

from advnerf_core.strict import StrictModel
from hardware.worlds.lab.config import CameraConfig, PhotoConfig
from hardware.worlds.remote_world import ServerDeadlines


class MetaDriveRoadConfig(StrictModel):
    """A road of MetaDrive's generator, and the driven stretch of its route.

    Attributes:
        blocks: One letter per block after the straight that every road begins with: S straight, C curve, r and R ramps, X crossing, O roundabout,
            T junction, P parking, y and Y lanes that merge and split, and others of MetaDrive's documentation.
        seed: Seed of the generator: lengths, radii, directions.
        lanes: Lanes per direction.
        lane_width_m: Width of a lane [m].
        lane: Index of the driven lane; 0 is beside the middle of the road.
        from_m: Start of the driven stretch along the route [m].
        length_m: Length of the driven stretch [m]; a shorter route is driven to its end.
    """

    blocks: str = Field(default="CS", min_length=1, pattern="^[A-Za-z$]+$")
    seed: int = Field(default=5, ge=0)
    lanes: int = Field(default=2, ge=1, le=6)
    lane_width_m: float = Field(default=3.5, ge=2.5, le=5.0)
    lane: int = Field(default=1, ge=0)
    from_m: float = Field(default=30.0, ge=0.0)
    length_m: float = Field(default=90.0, gt=10.0)


class MetaDriveCarConfig(StrictModel):
    """The car: MetaDrive's own Bullet vehicle under a speed and steering controller, or an ideal one.

    Attributes:
        own: Whether MetaDrive's vehicle drives; else an ideal kinematic bicycle.
        model: MetaDrive's vehicle model; it also sets the wheelbase.
        speed_mps: Speed of the experiments [m/s].
        max_wheel_rad: Wheel angles are clipped to plus and minus this [rad].
    """

    own: bool = True
    model: Literal["default", "s", "m", "l", "xl"] = "default"
    speed_mps: float = Field(default=6.0, gt=0.0, le=20.0)
    max_wheel_rad: float = Field(default=0.4, gt=0.0, le=0.6)


class MetaDriveConfig(StrictModel):
    """The whole world.

    Attributes:
        road: Road and driven stretch.
        camera: Driving camera, mounted relative to the rear axle.
        photo: Camera of the posed images that a surrogate is learned from.
        car: The car.
        traffic_density: Vehicles of MetaDrive's own traffic per 10 m of lane; 0 for none.
        supersampling: Every pixel is the mean of this number squared.
        sky: Whether MetaDrive's sky is drawn.
        terrain: Whether its grass is drawn.
        anisotropic: Whether textures use MetaDrive's anisotropic filters, 8 and 16 samples long; software rendering then takes several times as long.
        server: Deadlines of its process.
    """

    road: MetaDriveRoadConfig = MetaDriveRoadConfig()
    camera: CameraConfig = CameraConfig(x_m=1.2, z_m=1.5, pitch_down_rad=math.radians(8.0))
    photo: PhotoConfig = PhotoConfig()
    car: MetaDriveCarConfig = MetaDriveCarConfig()
    traffic_density: float = Field(default=0.0, ge=0.0, le=1.0)
    supersampling: Literal[1, 3] = 3
    sky: bool = True
    terrain: bool = True
    anisotropic: bool = False
    server: ServerDeadlines = Field(default=ServerDeadlines(), exclude=True)
