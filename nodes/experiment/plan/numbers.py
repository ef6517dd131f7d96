"""Numbers in experiment files."""

from typing import Annotated

from pydantic import Field

from advnerf_core.strict import LagS, LengthM

_LARGEST = 2**31 - 1  # what kernels and generators of random numbers count with
Count = Annotated[int, Field(ge=0, le=_LARGEST)]
# No computer drives, photographs or trains so often in a month: a zero too many, or milliseconds for ticks.
Positive = Annotated[int, Field(ge=1, le=1_000_000)]
PositiveNumber = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Unit = Annotated[float, Field(ge=0, le=1)]
Length = Annotated[LengthM, Field(gt=0)]
Distance = Annotated[LengthM, Field(ge=0)]
Delay = Annotated[LagS, Field(ge=0)]
