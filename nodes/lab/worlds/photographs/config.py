"""Configuration of a place that is known by photographs: the pictures, the path, the car and its camera."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, ValidationInfo, computed_field, model_validator

from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.views import PosedImages
from advnerf_core.geometry import Pinhole
from advnerf_core.strict import AngularRate, LengthM, RightAngleRad, SpeedMps, StrictModel
from hardware.worlds.world import CarDescription
from nodes.lab.located import content_sha256, located

DRIVEN = "driven"
AboveZero = Annotated[float, Field(gt=0.0)]


def _located(name: str, info: ValidationInfo) -> str:
    return name if name == DRIVEN else str(located(Path(name), info))


Located = Annotated[str, AfterValidator(_located)]


class DrivenCarConfig(StrictModel):
    """The car for the drives.

    Attributes:
        speed_mps: Speed of all drives [m/s].
        wheelbase_m: Distance between the axles [m]; None for a car that turns by the difference of its wheels.
        max_steering_rad: Largest angle of the front wheels to either side [rad]; without a wheelbase, largest turn rate [rad/s].
    """

    speed_mps: SpeedMps = Field(gt=0.0)
    wheelbase_m: Annotated[LengthM, Field(gt=0.0)] | None
    max_steering_rad: Annotated[AngularRate, Field(gt=0.0)]

    @model_validator(mode="after")
    def _wheels_turn_less_than_sideways(self) -> DrivenCarConfig:
        if self.wheelbase_m is not None and self.max_steering_rad >= 1.5:
            raise ValueError(f"max_steering_rad: expected less than 1.5 rad, got {self.max_steering_rad:g}")
        return self

    @property
    def described(self) -> CarDescription:
        """The description that worlds give of their cars."""
        kind: Literal["dubins", "ackermann"] = "dubins" if self.wheelbase_m is None else "ackermann"
        limits = (-self.max_steering_rad, self.max_steering_rad)
        return CarDescription(kind, self.speed_mps, limits, self.wheelbase_m)


class MountedCameraConfig(StrictModel):
    """The driving camera on that car.

    Attributes:
        x_m: Position ahead of the rear axle [m].
        y_m: Position left of the car's middle [m].
        z_m: Height above the ground [m].
        pitch_down_rad: Angle of the optical axis below the horizon [rad]; None: the driven photographs'.
        pinhole: Intrinsics of the camera; None: the photographs', undistorted.
    """

    x_m: LengthM = 0.0
    y_m: LengthM = 0.0
    z_m: LengthM = Field(gt=0.0)
    pitch_down_rad: RightAngleRad | None = None
    pinhole: Pinhole | None = None


class PhotographsConfig(StrictModel):
    """A place that is known by photographs.

    Attributes:
        images: ``transforms.json`` of posed images, or its folder, in metres with z up; ``advnerf scene from-...`` makes one.
        path: ``driven``: the photographs were taken while driving, in the listed order; or the ``.json`` file of those
            taken while driving, such as ``transforms_car.json``; or a CSV file with columns x_m, y_m in driving order, in the frame of the photographs.
        closed: Whether the path is a loop.
        off_track_m: Half the width of the lane [m].
        ground_z_m: Height of the ground in the frame of the photographs [m]; None: below the driven ones, by the camera's height.
        car: The car.
        camera: The driving camera.
        reach_m: Largest relevant distance from the cameras [m]: the learned region is then a box, which renders ten times as fast; None:
            everything to the horizon is learned.
        half: Learn from every second photograph only; None: from all. Two scenes of a place, one from each half, show how much of
            an attack is due to the place and how much to one scene.
    """

    images: Located = Field(exclude=True)
    path: Located = Field(default=DRIVEN, exclude=True)
    closed: bool = False
    off_track_m: Annotated[LengthM, Field(gt=0.0)]
    ground_z_m: float | None = None
    car: DrivenCarConfig
    camera: MountedCameraConfig
    reach_m: AboveZero | None = None
    half: Literal["even", "odd"] | None = None

    @model_validator(mode="after")
    def _ground_is_known(self) -> PhotographsConfig:
        if not self.shows_path and (self.ground_z_m is None or self.camera.pitch_down_rad is None):
            raise ValueError(
                "expected ground_z_m and camera.pitch_down_rad with a path from a file, as photographs that nobody drove for do not show them; give "
                "both, for example --set world.ground_z_m=0 --set world.camera.pitch_down_rad=0.1"
            )
        return self

    @property
    def shows_path(self) -> bool:
        """Whether photographs show the path, instead of a file of points."""
        return self.path == DRIVEN or self.path.endswith(".json")

    @property
    def driven(self) -> PosedImages:
        """The photographs that were taken while driving, in their order; without any, all of them."""
        return read_images(self.path if self.path.endswith(".json") else self.images)

    @computed_field  # type: ignore[prop-decorator]
    @property
    def content_sha256(self) -> str:
        """Hash of the photographs, their poses and the path, independent of their folders."""
        listed = read_images(self.images)
        files = {each.path for each in listed.frames} | {each.mask for each in listed.frames if each.mask}
        files |= {listed.file} if listed.file else set()
        if self.path != DRIVEN:
            files |= {Path(self.path), *(each.path for each in self.driven.frames)}
        digests = [content_sha256(each) for each in sorted(files)]
        return hashlib.sha256("".join(digests).encode()).hexdigest()


def read_images(images: str) -> PosedImages:
    """The posed images at a path, all of which must exist.

    Raises:
        DatasetError: They cannot be read.
    """
    return load_transforms(Path(images), require_all=True)
