"""Common keys of requests and experiments for a search: its objective, its budget, and the sampling of places and shapes."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from advnerf_core.attack.objectives import CTE
from advnerf_core.strict import StrictModel
from nodes.experiment.plan.method_names import ObjectiveReference


class SearchBudget(StrictModel):
    """The objective of a search, and its budget."""

    objective: ObjectiveReference = Field(
        default=CTE,
        description="What is maximised: cte, peak, time_off_track, collision, or file.py:Class, relative to this file.",
    )
    evaluations: Annotated[int, Field(ge=1)] = Field(
        default=50, description="Closed-loop evaluations of each search; an iteration of the gradient is one."
    )
    population: Annotated[int, Field(ge=4)] = Field(default=10, description="Candidates of a generation.")
    time_batch: Annotated[int, Field(ge=1)] = Field(default=16, description="Frames per gradient batch.")
    cache_mib: Annotated[float, Field(ge=0)] = Field(
        default=512.0, description="Budget of the frames kept for the gradient [MiB]."
    )


class PlacesBudget(StrictModel):
    """The budget of a search of places: ``samples * steps`` evaluations, for random places as well."""

    colours: bool = Field(default=True, description="Whether the colours are searched too.")
    samples: Annotated[int, Field(ge=1)] = Field(default=5, description="Placements that are drawn.")
    steps: Annotated[int, Field(ge=1)] = Field(default=10, description="Evaluations of each placement.")

    @property
    def evaluations(self) -> int:
        """Closed-loop evaluations of a search."""
        return self.samples * self.steps


class ShapeSampling(StrictModel):
    """Sampling of the gradient of a mesh's shape."""

    smoothness: Annotated[float, Field(ge=0)] = Field(
        default=19.0, description="Lambda of the large-steps preconditioner; 0: none."
    )
    samples: Annotated[int, Field(ge=1, le=256)] = Field(
        default=4, description="Rays a pixel for the gradient inside the silhouettes."
    )
    boundary_samples: Annotated[int, Field(ge=1, le=256)] = Field(
        default=1, description="Points a pixel for that of the silhouettes."
    )
