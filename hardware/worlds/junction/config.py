"""Every number of the simulated intersection: roads, cameras, the car's true behaviour."""

from __future__ import annotations

import math

from pydantic import Field, model_validator

from advnerf_core.strict import AngularRate, LagS, LengthM, SpeedMps, StrictModel
from hardware.worlds.junction.paths import PathName, junction_paths
from hardware.worlds.lab.config import CameraConfig, PhotoConfig
from hardware.worlds.paths import ReferencePath
from hardware.worlds.world import CarDescription


class RoadConfig(StrictModel):
    """A main road along x with a side road to the south (negative y), two lanes each; the origin is the junction's middle.

    Attributes:
        lane_width_m: Width of a lane [m]; vehicles keep to the right.
        corner_radius_m: Radius of the kerb at the two corners [m].
        kerb_height_m: Height of kerb and pavement above the asphalt [m].
        pavement_width_m: From the asphalt to the front gardens, kerb stone included [m].
        half_m: The world ends at plus and minus this in x and y [m].
        sky_m: Height of the painted sky's ceiling [m].
        seed: Seed of the procedural textures.
    """

    lane_width_m: float = Field(default=3.5, ge=2.5, le=5.0)
    corner_radius_m: float = Field(default=6.0, ge=2.0, le=12.0)
    kerb_height_m: float = Field(default=0.12, ge=0.02, le=0.3)
    pavement_width_m: float = Field(default=3.0, ge=1.0, le=4.0)
    half_m: float = Field(default=60.0, ge=50.0, le=100.0)
    sky_m: float = Field(default=36.0, ge=20.0)
    seed: int = Field(default=11, ge=0)


# Keys of a world with this car (``car:``) that change how it moves, and neither a picture nor its description.
UNSEEN_OF_A_CAR = (
    "car.turn_rate_lag_s",
    "car.turn_rate_gain",
    "car.body_length_m",
    "car.body_width_m",
    "car.body_ahead_m",
)


class DubinsConfig(StrictModel):
    """The car: its nominal behaviour, and its true one.

    Attributes:
        speed_mps: Speed of the experiments [m/s].
        max_turn_rate_radps: Commands are clipped to plus and minus this [rad/s].
        turn_rate_lag_s: Time constant with which the turn rate follows its command [s]; 0 for none.
        turn_rate_gain: True turn rate over the commanded one; 1 for a car without error.
        body_length_m: Length of the body [m].
        body_width_m: Width of the body [m].
        body_ahead_m: Middle of the body ahead of the reference point, which moves along the heading [m].
    """

    speed_mps: SpeedMps = Field(default=6.0, gt=0.0)
    max_turn_rate_radps: AngularRate = Field(default=1.2, gt=0.0)
    turn_rate_lag_s: LagS = Field(default=0.12, ge=0.0)
    turn_rate_gain: float = Field(default=1.02, gt=0.0)
    body_length_m: LengthM = Field(default=3.6, gt=0.0)
    body_width_m: LengthM = Field(default=1.6, gt=0.0)
    body_ahead_m: LengthM = 1.2

    @classmethod
    def ideal(cls) -> DubinsConfig:
        """The car as the surrogate models it: no lag, no gain error."""
        return cls(turn_rate_lag_s=0.0, turn_rate_gain=1.0)

    @property
    def description(self) -> CarDescription:
        """The description of the car for an attack."""
        bound = self.max_turn_rate_radps
        return CarDescription("dubins", self.speed_mps, (-bound, bound))


class IntersectionConfig(StrictModel):
    """The whole simulated intersection; the defaults are the scene of the experiments.

    Attributes:
        road: Roads, pavements and the world's size.
        camera: Driving camera, mounted relative to the car's reference point.
        photo: Camera of the posed images that a surrogate is learned from.
        car: Vehicle.
        approach_m: Distance of the drives' starts from the junction's middle [m].
        left_radius_m: Radius of the left turn [m]; the right turn is concentric with the kerb.
        beyond_m: Length of the road after a turn that belongs to the reference path [m].
        supersampling: Images are drawn this many times larger per axis and averaged.
    """

    road: RoadConfig = RoadConfig()
    camera: CameraConfig = CameraConfig(x_m=1.2, z_m=1.5, pitch_down_rad=math.radians(8.0))
    photo: PhotoConfig = PhotoConfig()
    car: DubinsConfig = DubinsConfig()
    approach_m: float = Field(default=24.0, gt=0.0)
    left_radius_m: float = Field(default=8.75, gt=0.0)
    beyond_m: float = Field(default=30.0, gt=0.0)
    supersampling: int = Field(default=2, ge=1, le=4)

    @model_validator(mode="after")
    def _corners_have_a_pavement(self) -> IntersectionConfig:
        road = self.road
        if road.pavement_width_m >= road.corner_radius_m:
            raise ValueError(
                f"expected a pavement narrower than the corners' radius of {road.corner_radius_m} m, got {road.pavement_width_m} m"
            )
        return self

    @model_validator(mode="after")
    def _drivable(self) -> IntersectionConfig:
        half_lane, radius = 0.5 * self.road.lane_width_m, max(self.right_radius_m, self.left_radius_m)
        if not half_lane + radius < self.approach_m <= self.road.half_m - 10.0:
            raise ValueError(
                f"expected half a lane + the radius of the turns = {half_lane + radius} m < approach_m <= half_m - 10 = "
                f"{self.road.half_m - 10.0} m, got {self.approach_m} m"
            )
        tightest = self.car.speed_mps / self.car.max_turn_rate_radps
        if min(self.right_radius_m, self.left_radius_m) < tightest:
            raise ValueError(
                f"expected turns the car can follow, of at least speed / turn rate = {tightest:.2f} m, got a right turn of "
                f"{self.right_radius_m} m and a left turn of {self.left_radius_m} m"
            )
        return self

    @property
    def right_radius_m(self) -> float:
        """Radius of the right turn along the middle of the lane [m]: concentric with the kerb."""
        return self.road.corner_radius_m + 0.5 * self.road.lane_width_m

    @property
    def off_track_m(self) -> float:
        """Cross-track error beyond which the car has left its lane [m]."""
        return 0.5 * self.road.lane_width_m

    def on_road(self, x_m: float, y_m: float) -> bool:
        """Whether a point lies on the asphalt, rounded corners included."""
        width, radius = self.road.lane_width_m, self.road.corner_radius_m
        if abs(y_m) < width or (y_m < 0.0 and abs(x_m) < width):
            return True
        if y_m > 0.0 or abs(x_m) > width + radius or y_m < -width - radius:
            return False
        return math.hypot(abs(x_m) - width - radius, y_m + width + radius) > radius

    def lanes(self) -> tuple[ReferencePath, ...]:
        """Middles of all lanes, also of those that no drive uses; no object may stand in any of them."""
        driven = self.paths()
        return (*driven.values(), driven["straight"].mirrored("x"), driven["right"].mirrored("y"))

    def paths(self) -> dict[PathName, ReferencePath]:
        """The drives "straight", "right" and "left"."""
        return junction_paths(
            self.road.lane_width_m, self.right_radius_m, self.left_radius_m, self.approach_m, self.beyond_m
        )
