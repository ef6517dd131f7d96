"""Parts of an audit's result: the policy, the place, the objects, and the drives past them.

Distances are in metres and angles in radians, in the world frame of the place (z up). A vehicle's pose is its rear axle's
centre on the ground.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from advnerf_core.strict import StrictModel

Evidence = Literal["surrogate", "world", "live"]
PlaceKind = Literal["images", "video", "scene", "splat", "world"]
Scale = Literal["world", "poses", "length", "positions", "fiducials"]
Control = Literal["no_object", "plain_object"]

Text = Annotated[str, Field(min_length=1)]
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(gt=0.0, lt=1.0)]
# Stored means must equal those of the stored drives up to this [m]; both come from the same numbers.
_ROUNDING_M = 1e-6


class AuditQuestion(StrictModel):
    """The resolved experiment file that the audit ran."""

    file: Text = Field(description="Name of the file in the audit's folder.")
    sha256: Sha256


class AuditedPolicy(StrictModel):
    """The policy that was audited."""

    path: Text = Field(description="File, module:factory or address, as the user gave it.")
    sha256: Sha256 | None = Field(description="Of the file; null for a policy without one.")


class AuditedPlace(StrictModel):
    """The place of the audit."""

    name: Text = Field(description="As sentences name it: MetaDrive, the hall.")
    kind: PlaceKind
    source: Text = Field(description="Folder, file or name of the world, as the user gave it.")
    scale: Scale | None = Field(
        description="What the metre comes from; null if nothing tells it. Then the result holds no effect."
    )
    off_track_m: Positive | None = Field(
        description="|CTE| beyond which the vehicle has left its lane [m]; null without a known scale."
    )
    road_network: Text | None = Field(
        default=None, description="OpenDRIVE file of the place; null if it has none."
    )


class AuditedVehicle(StrictModel):
    """The vehicle that the policy drives. Sizes that the audit did not need are null."""

    name: Text
    wheelbase_m: Positive
    speed_mps: Positive = Field(description="Speed at which it was driven [m/s].")
    max_steering_rad: Positive | None = None
    length_m: Positive | None = None
    width_m: Positive | None = None
    height_m: Positive | None = None


class PlacedPose(StrictModel):
    """Position of an object's origin [m] and its attitude [rad], yaw then pitch then roll about z, y and x."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    pitch_rad: float = 0.0
    roll_rad: float = 0.0


class AuditedObject(StrictModel):
    """An object that was placed."""

    name: Text
    kind: Text = Field(description="panel, cube, billboard, mesh or another kind.")
    size_m: tuple[Positive, Positive, Positive] = Field(
        description="Extent along the object's own x (depth), y (width) and z (height) [m]; its origin is the middle of its foot."
    )
    pose: PlacedPose
    texture: Text | None = Field(description="Picture in the audit's folder; null if it has none.")
    texture_sha256: Sha256 | None = None
    model: Text | None = Field(default=None, description="GLB file in the audit's folder.")


class RoutePoint(StrictModel):
    """Pose of the vehicle at a time."""

    t_s: NotNegative
    x_m: float
    y_m: float
    yaw_rad: float


class AuditEffect(StrictModel):
    """Increase of the vehicle's distance from its path by the object: mean over the judging starts, and its interval [m]."""

    mean_m: float
    low_m: float
    high_m: float
    level: Share = 0.95

    @model_validator(mode="after")
    def _in_order(self) -> AuditEffect:
        if not self.low_m <= self.mean_m <= self.high_m:
            raise ValueError(
                f"expected low_m <= mean_m <= high_m, got {self.low_m}, {self.mean_m}, {self.high_m}"
            )
        return self


class JudgedStart(StrictModel):
    """Two drives from one judging start: with the object, and with the control."""

    x_m: float
    y_m: float
    yaw_rad: float
    off_path_m: NotNegative = Field(
        description="Distance from the path with the object, by the judgement's measure [m]."
    )
    control_off_path_m: NotNegative = Field(description="The same with the control [m].")
    off_track: bool = Field(description="Whether the vehicle left its lane with the object.")
    control_off_track: bool


class DisturbedDrives(StrictModel):
    """Drives from the judging starts with a worse camera: what was found is not always what bears noise and a shaking mount.

    Noise and jitter are drawn for each picture, gain and brightness for each drive; all are standard deviations.
    """

    noise: NotNegative = Field(description="Of each channel of each pixel, in 0..1.")
    gain: NotNegative = Field(description="Of the logarithm of the exposure.")
    brightness: NotNegative = Field(description="Added to all pixels, in 0..1.")
    jitter_m: NotNegative = Field(description="Of the camera's position along each axis [m].")
    jitter_rad: NotNegative = Field(description="Of the camera's rotation about each axis [rad].")
    effect: AuditEffect = Field(description="Over the plain object under the same camera.")
    off_track: Annotated[int, Field(ge=0)]
    plain_off_track: Annotated[int, Field(ge=0)]


class AuditedDrives(StrictModel):
    """Drives past an object from the judging starts, which neither search nor selection used."""

    evidence: Evidence = Field(
        description="Where it was driven: in the learned copy of the place, in a world, or by a real vehicle."
    )
    measure: Literal["mean_abs_cte", "max_abs_cte"] = Field(description="What off_path_m is of a drive.")
    control: Control = Field(description="Which control gives the smaller effect.")
    effect: AuditEffect
    disturbed: DisturbedDrives | None = Field(
        default=None, description="The same under a worse camera; null where the camera is the world's own."
    )
    starts: tuple[JudgedStart, ...] = Field(min_length=2)
    path: tuple[RoutePoint, ...] = Field(
        default=(), description="The reference path that the vehicle should follow."
    )
    route: tuple[RoutePoint, ...] = Field(
        default=(), description="What the vehicle drove with the object, from the median start."
    )

    @model_validator(mode="after")
    def _agrees(self) -> AuditedDrives:
        mean_m = sum(each.off_path_m - each.control_off_path_m for each in self.starts) / len(self.starts)
        if abs(mean_m - self.effect.mean_m) > _ROUNDING_M:
            raise ValueError(
                f"expected effect.mean_m to be the mean over the starts, {mean_m:.6f} m, got {self.effect.mean_m}"
            )
        for name, points in (("path", self.path), ("route", self.route)):
            if any(after.t_s <= before.t_s for before, after in pairwise(points)):
                raise ValueError(f"expected increasing t_s in {name}")
        return self

    @property
    def off_track(self) -> int:
        """Number of starts from which the vehicle left its lane with the object."""
        return sum(each.off_track for each in self.starts)


class JudgedObject(StrictModel):
    """The object that was strongest on the selection starts, and its effect from the judging starts."""

    object: AuditedObject
    judgements: tuple[AuditedDrives, ...] = Field(min_length=1, description="One for each kind of evidence.")

    @model_validator(mode="after")
    def _one_each(self) -> JudgedObject:
        kinds = [each.evidence for each in self.judgements]
        if len(set(kinds)) < len(kinds):
            raise ValueError(f"expected one judgement for each kind of evidence, got {', '.join(kinds)}")
        return self
