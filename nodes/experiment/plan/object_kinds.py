"""Kinds of objects that an experiment places: built-in ones, and a user's object and mesh files."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import AfterValidator, PlainSerializer, SerializationInfo, ValidationInfo

from advnerf_core.files import sha256_of
from advnerf_core.plugins import unknown
from nodes.lab.located import beside, is_read_again, refusal

if TYPE_CHECKING:
    from advnerf_core.objects.voxel.mesh import SurfaceMesh

PANEL, CUBE, BALL = "panel", "cube", "ball"
# Length, width and height [m] at scale 1: of the objects that ``advnerf scene object build --generate`` makes, of a square panel that stands upright,
# and of what only a learned scene of a user's own takes: a cube with one textured face, and a ball.
MADE_HERE_M: dict[str, tuple[float, float, float]] = {
    "small_car": (3.64, 1.7, 1.46),
    "hydrant": (0.48, 0.48, 0.75),
    PANEL: (0.1, 2.0, 2.0),
    CUBE: (2.0, 2.0, 2.0),
    BALL: (0.7, 0.7, 0.7),
}
# What ``advnerf scene object build`` writes; meshes whose format specifies the unit; and meshes whose unit must be given.
OBJECT_SUFFIX, MESH_SUFFIXES, UNITLESS_SUFFIXES = (
    ".object.safetensors",
    (".glb", ".gltf"),
    (".obj", ".ply", ".stl"),
)


def _located(kind: str, info: ValidationInfo) -> str:
    if kind in MADE_HERE_M:
        return kind
    if not kind.endswith((OBJECT_SUFFIX, *MESH_SUFFIXES, *UNITLESS_SUFFIXES)):
        raise refusal(
            f"{unknown(kind, 'kind of object', MADE_HERE_M)}; one of your own is a file of 'advnerf scene object build' "
            f"(*{OBJECT_SUFFIX}) or a mesh ({', '.join(MESH_SUFFIXES)}, in metres), relative to this file"
        )
    file = beside(kind, info)
    if not file.is_file():
        raise refusal(
            f"expected an object or mesh file relative to this file, got {kind}, which is not there"
        )
    return str(file.resolve())


def name_of(kind: str) -> str:
    """Name of a kind in results: for a file its name, without its folder."""
    return kind if kind in MADE_HERE_M else Path(kind).name


def _written(kind: str, info: SerializationInfo) -> str:
    return kind if is_read_again(info) else name_of(kind)


ObjectKind = Annotated[str, AfterValidator(_located), PlainSerializer(_written)]
"""A kind of object; a file becomes absolute, and what results depend on has its name alone: its content counts, see `files_of`."""


def is_mesh(kind: str) -> bool:
    """Whether a kind is a user's mesh."""
    return kind.endswith((*MESH_SUFFIXES, *UNITLESS_SUFFIXES))


def files_of(kinds: list[str]) -> dict[str, str]:
    """Hash of each kind that is a file, by its name in results."""
    from advnerf_core.objects.voxel.mesh_files import read_mesh_files

    return {
        name_of(kind): read_mesh_files(Path(kind))[0].sha256() if is_mesh(kind) else sha256_of(Path(kind))
        for kind in kinds
        if kind not in MADE_HERE_M
    }


def footprint_m(kind: str) -> tuple[float, float]:
    """Length and width [m] of the ground that an object of a kind covers at scale 1; raises as `extent_m`."""
    return extent_m(kind)[:2]


def extent_m(
    kind: str, up: str | None = None, height_m: float | None = None, unit: str | None = None
) -> tuple[float, float, float]:
    """Length, width and height [m] of an object of a kind at scale 1, about the axis that it turns around.

    Args:
        up: Up axis of a mesh's file.
        height_m: Height to which it is scaled [m].
        unit: Unit of a mesh's file.

    Raises:
        MeshError, ObjectFileError: The file cannot be read.
    """
    if kind in MADE_HERE_M:
        length, width, height = MADE_HERE_M[kind]
        factor = 1.0 if height_m is None else height_m / height
        return factor * length, factor * width, factor * height
    return _extent_m(kind, Path(kind).stat().st_mtime_ns, up, height_m, unit)


@lru_cache(maxsize=16)
def _extent_m(
    kind: str, changed_ns: int, up: str | None, height_m: float | None, unit: str | None
) -> tuple[float, float, float]:
    del changed_ns  # part of the cache's key
    if is_mesh(kind):
        low, high = load_mesh_of(kind, up, height_m, unit).box
    else:
        from advnerf_core.objects.voxel.model import load_object

        low, high = load_object(Path(kind)).solid_box
    # It turns about its axis, which need not be in its middle.
    length, width = 2.0 * np.maximum(np.abs(low), np.abs(high))[:2]
    return float(length), float(width), float(high[2] - low[2])


def load_mesh_of(
    kind: str, up: str | None = None, height_m: float | None = None, unit: str | None = None
) -> SurfaceMesh:
    """A user's mesh: upright, its base on the ground; see `load_mesh`.

    Raises:
        MeshError: The mesh cannot be read.
    """
    from advnerf_core.objects.voxel.mesh_files import load_mesh

    return load_mesh(Path(kind), up, height_m, unit)
