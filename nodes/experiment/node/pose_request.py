"""The key ``poses`` of a request for an attack: where objects may stand, and what is mapped."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field, field_validator

from advnerf_core.strict import StrictModel
from nodes.experiment.plan.search_config import PlacesBudget

Count = Annotated[int, Field(ge=1)]
AboveZero = Annotated[float, Field(gt=0)]
Numbers = Annotated[tuple[float, ...], Field(min_length=1)]
Interval = tuple[float, float]


class PoseBoundsRequest(StrictModel):
    """Bounds of one object; an axis that is not given stays as it is."""

    x_m: Interval | None = Field(default=None, description="Lowest and highest x of the object's origin [m].")
    y_m: Interval | None = Field(default=None, description="The same of y [m].")
    yaw_rad: Interval | None = Field(default=None, description="Of its heading [rad].")
    scale: Interval | None = Field(
        default=None, description="Of the world metres per object unit; not of a face."
    )

    @field_validator("x_m", "y_m", "yaw_rad", "scale")
    @classmethod
    def _ordered(cls, interval: Interval | None) -> Interval | None:
        if interval is not None and interval[0] > interval[1]:
            raise ValueError(f"expected the lower bound first, got {list(interval)}")
        return interval


class LandscapeRequest(StrictModel):
    """A grid over the bounds of one object."""

    object: Annotated[int, Field(ge=0)] = Field(default=0, description="Number of the object.")
    points: tuple[Count, Count] = Field(default=(11, 11), description="Points along x and y.")
    yaws_rad: tuple[float, ...] = Field(
        default=(), description="Headings [rad]; the found one if none is given."
    )


class RobustnessMapRequest(StrictModel):
    """Starts and moves of an object; the map has every start with every move."""

    object: Annotated[int, Field(ge=0)] = Field(default=0, description="Number of the object that is moved.")
    sideways_m: Numbers = Field(
        default=(-0.2, -0.1, 0.0, 0.1, 0.2), description="Starts: to the left of the nominal one [m]."
    )
    turn_rad: Numbers = Field(
        default=(0.0,), description="Starts: turned to the left [rad]; each with each sideways."
    )
    object_moves_m: tuple[tuple[float, float], ...] = Field(
        default=((0.0, 0.0), (-0.2, 0.0), (0.2, 0.0), (0.0, -0.2), (0.0, 0.2)),
        min_length=1,
        description="Moves of the object along x and y [m].",
    )
    object_turns_rad: Numbers = Field(
        default=(0.0,), description="Turns of the object [rad]; each with each move."
    )


class PosesRequest(PlacesBudget):
    """Where objects may stand, and the budget."""

    bounds: tuple[PoseBoundsRequest, ...] = Field(
        min_length=1, description="One for each object, in their order."
    )
    keep_out_m: Annotated[float, Field(ge=0)] = Field(
        default=0.4, description="Least distance of every footprint from the reference path [m]."
    )
    pose_rate: AboveZero = Field(
        default=0.1, description="Adam's step of a pose; 2 is the whole width of the bounds."
    )
    colour_rate: AboveZero = Field(default=0.1, description="Adam's step of the colours before squashing.")
    edge_width: AboveZero | None = Field(
        default=None, description="Width of the soft edges [object units]; two voxels if not given."
    )
    attack: Path | None = Field(
        default=None, description="Attack file whose colours objects have where colours are not searched for."
    )
    landscape: LandscapeRequest = LandscapeRequest()
    robustness: RobustnessMapRequest = RobustnessMapRequest()
