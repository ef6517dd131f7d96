"""Numbers in experiment files."""

import math
from typing import Annotated

from pydantic import AfterValidator, Field

Count = Annotated[int, Field(ge=0)]
Positive = Annotated[int, Field(ge=1)]
PositiveNumber = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Unit = Annotated[float, Field(ge=0, le=1)]
# Of a steering's response: above this, seconds were meant to be milliseconds.
Delay = Annotated[float, Field(ge=0, le=5)]


def _within_a_turn(angle_rad: float) -> float:
    if abs(angle_rad) > 2.0 * math.pi:
        raise ValueError(
            f"expected radians, at most a turn of 6.2832, got {angle_rad:g}; as degrees that is {math.radians(angle_rad):.4f}"
        )
    return angle_rad


Angle = Annotated[float, AfterValidator(_within_a_turn)]
"""An angle [rad]; degrees are refused where they are more than a turn."""
