"""The section ``maps`` of an experiment: what is mapped about what a search of places found. No result depends on it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from advnerf_core.strict import Angle, LengthM, StrictModel
from nodes.experiment.plan.numbers import Count, Positive

Lengths = Annotated[tuple[LengthM, ...], Field(min_length=1)]
Angles = Annotated[tuple[Angle, ...], Field(min_length=1)]


class LandscapeConfig(StrictModel):
    """A grid over the bounds of one object."""

    points: tuple[Positive, Positive] = Field(default=(9, 9), description="Points along x and y.")
    yaws_rad: tuple[Angle, ...] = Field(
        default=(), description="Headings [rad]; the found one if none is given."
    )


class RobustnessMapConfig(StrictModel):
    """Starts and moves of an object; the map has every start with every move."""

    sideways_m: Lengths = Field(
        default=(-0.6, -0.3, 0.0, 0.3, 0.6), description="Starts: to the left of the first one [m]."
    )
    turn_rad: Angles = Field(
        default=(0.0,), description="Starts: turned to the left [rad]; each with each sideways."
    )
    object_moves_m: tuple[tuple[LengthM, LengthM], ...] = Field(
        default=((0.0, 0.0), (-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)),
        min_length=1,
        description="Moves of the object along x and y [m].",
    )
    object_turns_rad: Angles = Field(
        default=(0.0,), description="Turns of the object [rad]; each with each move."
    )


class MapsConfig(StrictModel):
    """Maps to make."""

    object: Count = Field(default=0, description="Number of the object that is moved.")
    landscape: LandscapeConfig = LandscapeConfig()
    robustness: RobustnessMapConfig = RobustnessMapConfig()
