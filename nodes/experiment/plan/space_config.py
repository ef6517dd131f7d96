"""The sections ``space`` and ``maps`` of an experiment: the parameters of its attacks, with the report's words for them (``searched``), and what
is mapped about what a search of places found. No result depends on the maps."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from advnerf_core.strict import Angle, LengthM, StrictModel
from nodes.experiment.plan.numbers import Count, Distance, Length, NotNegative, Positive, PositiveNumber, Unit
from nodes.lab.located import NamedFile


class ColoursConfig(StrictModel):
    """The colours of the objects."""

    kind: Literal["colours"]
    searched: ClassVar[str] = "The colours of {} are searched together in the learned scene"
    cells: Count = Field(
        default=0,
        description="Cells along each edge of coarse random textures; 0: as many as the objects have colours.",
    )


class PlacesConfig(StrictModel):
    """Places of the objects, and their colours unless these are fixed: ``samples * steps`` evaluations, for random places as well."""

    kind: Literal["places"]
    searched: ClassVar[str] = "The places of {} are searched together in the learned scene"
    colours: bool = Field(default=True, description="Whether the colours are searched too.")
    samples: Positive = Field(default=5, description="Placements that are drawn.")
    steps: Positive = Field(default=10, description="Evaluations of each placement.")
    move_m: Distance = Field(default=1.5, description="An object's x and y may change by this [m].")
    turn_rad: Angle = Field(
        default=0.6,
        ge=0.0,
        description="A car's heading may change by this [rad]; a hydrant may turn all the way round.",
    )
    pose_rate: PositiveNumber = Field(
        default=0.1, description="Adam's step of a pose; 2 is the whole width of the bounds."
    )
    colour_rate: PositiveNumber = Field(
        default=0.5, description="Adam's step of the colours before squashing."
    )
    keep_out_m: Distance | None = Field(
        default=None,
        description="Least distance of every footprint from the middles of the lanes [m]; none: half a lane.",
    )
    edge_width: PositiveNumber | None = Field(
        default=None, description="Width of the soft edges [object units]; none: two voxels."
    )
    coloured_by: NamedFile | None = Field(
        default=None, description="Attack file whose colours the objects have where colours are not searched."
    )

    @property
    def evaluations(self) -> int:
        """Closed-loop evaluations of a search."""
        return self.samples * self.steps

    @model_validator(mode="after")
    def _coloured_once(self) -> PlacesConfig:
        if self.colours and self.coloured_by is not None:
            raise ValueError("expected space.colours false with coloured_by, whose colours are not searched")
        return self


class _MeshConfig(StrictModel):
    texels: Positive = Field(default=32, description="Texels along the longest side of an object.")
    ball_m: Length | None = Field(
        default=None,
        description="The objects are balls of this radius, before their own scale [m]; none: their meshes.",
    )
    ball_rgb: tuple[Unit, Unit, Unit] = Field(default=(0.75, 0.1, 0.08), description="Colour of the balls.")
    learning_rate: PositiveNumber | None = Field(
        default=None,
        description="Of Adam; none: attack.learning_rate for textures, a twentieth of the bound for shapes.",
    )


class MeshTextureConfig(_MeshConfig):
    """The textures of the objects as meshes, searched over the world's own pictures."""

    kind: Literal["mesh_texture"]
    searched: ClassVar[str] = "The textures of {} as meshes are searched over the world's own pictures"


class MeshShapeConfig(_MeshConfig):
    """The shapes of the objects as meshes, searched over the world's own pictures."""

    kind: Literal["mesh_shape"]
    searched: ClassVar[str] = "The shapes of {} as meshes are searched over the world's own pictures"
    bound_m: Length = Field(default=0.4, description="No vertex moves farther [m].")
    smoothness: NotNegative = Field(
        default=19.0, description="Lambda of the large-steps preconditioner; 0: none."
    )
    samples: Annotated[int, Field(ge=1, le=256)] = Field(
        default=4, description="Rays a pixel for the gradient inside the silhouettes."
    )
    boundary_samples: Annotated[int, Field(ge=1, le=256)] = Field(
        default=1, description="Points a pixel for that of the silhouettes."
    )


SpaceConfig = Annotated[
    ColoursConfig | PlacesConfig | MeshTextureConfig | MeshShapeConfig,
    Field(discriminator="kind"),
]

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
