"""What a request for an attack says about meshes: the mesh of an object, and the key ``shape``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from advnerf_core.strict import StrictModel
from nodes.experiment.plan.search_config import ShapeSampling

AboveZero = Annotated[float, Field(gt=0)]
Unit = Annotated[float, Field(ge=0, le=1)]


class MeshRequest(StrictModel):
    """A mesh: a file, or one that is made."""

    file: Path | None = Field(default=None, description="GLB, OBJ, PLY, STL.")
    generate: Literal["hydrant", "car", "ball"] | None = Field(default=None, description="Instead of a file.")
    up: Literal["z", "y"] | None = Field(
        default=None, description="Which axis of the file points up; y for glTF, z for others."
    )
    unit: Literal["mm", "cm", "m", "in"] | None = Field(
        default=None, description="The file's unit; needed for others than glTF, or give height_m."
    )
    height_m: AboveZero | None = Field(
        default=None, description="Scale to this height [m]; a ball's diameter."
    )
    texels: Annotated[int, Field(ge=2, le=512)] = Field(
        default=32, description="Texels along its longest side."
    )
    rgb: tuple[Unit, Unit, Unit] = Field(default=(0.75, 0.1, 0.08), description="Colour of a ball.")

    @model_validator(mode="after")
    def _one(self) -> MeshRequest:
        if (self.file is None) == (self.generate is None):
            raise ValueError("expected exactly one of file and generate")
        return self


class ShapeRequest(ShapeSampling):
    """Shapes are attacked instead of colours, of all objects, which must be meshes."""

    bound_m: AboveZero = Field(default=0.2, description="No vertex moves farther [m].")
