"""The objects of a request: their geometry, what is free, and the face that a projection or display can show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.fields.summed_levels import with_summed_levels
from advnerf_core.fields.voxel_grid import VoxelGridObject, cube_face_object, face_corners_in_object
from advnerf_core.geometry import Array
from advnerf_core.objects.voxel.model import load_object
from calibration.schema import TargetCalibration, load_calibration
from nodes.experiment.node.meshes import mesh_field, mesh_name
from nodes.experiment.node.request import ObjectRequest
from nodes.runtime.errors import ConfigError


@dataclass(frozen=True, eq=False)
class Face:
    """The deployable face of an object.

    Attributes:
        size_m: Width and height [m].
        subject: Motion-capture subject that carries it.
        corners_in_subject: Top left, top right, bottom right, bottom left for the viewer, ``[4, 3]`` [m].
    """

    size_m: tuple[float, float]
    subject: str
    corners_in_subject: Array


@dataclass(frozen=True, eq=False)
class LoadedObject:
    """An object of a request in the scene.

    Attributes:
        name: What it is, for people.
        field: Geometry, colours, pose.
        face: Its deployable face, whose colours are all of its theta ``[N, N, 3]``; None if it has none.
        sha256: Hash of geometry, fixed colours and pose.
    """

    name: str
    field: ColouredObject
    face: Face | None
    sha256: str


def place(wanted: ObjectRequest) -> LoadedObject:
    """Make the object of a request.

    Raises:
        ObjectFileError: An object file that cannot be read.
        MeshError: A mesh that cannot be read.
        ConfigError: A face of an object file: it has none that could be displayed.
    """
    if wanted.kind == "file":
        return _from_file(wanted)
    if wanted.mesh is not None:
        mesh, sha256 = mesh_field(wanted.mesh, wanted.pose, wanted.scale)
        return LoadedObject(mesh_name(wanted.mesh), mesh, None, sha256)
    field = cube_face_object(
        wanted.size_m,
        wanted.resolution,
        wanted.plain_rgb,
        wanted.pose,
        one_sided=wanted.kind == "face",
        depth_m=wanted.size_m if wanted.kind == "cube" else 0.01,
    )
    field = _scaled(field, wanted.scale)
    return LoadedObject(wanted.kind, field, _face(wanted), field.sha256)


def _from_file(wanted: ObjectRequest) -> LoadedObject:
    assert wanted.file is not None
    if wanted.free == "face" or wanted.target is not None:
        raise ConfigError(
            f"{wanted.file}: expected all colours of an object file to be free; only a face or cube has a face"
        )
    field = load_object(wanted.file).placed(wanted.pose, wanted.scale)
    if wanted.levels:
        field = with_summed_levels(field, wanted.levels, finest=max(field.slots.shape))
    return LoadedObject(wanted.file.name.partition(".")[0], field, None, field.sha256)


def _scaled(field: VoxelGridObject, scale: float) -> VoxelGridObject:
    return replace(field, scale=field.scale * scale)


def _face(wanted: ObjectRequest) -> Face:
    size_m = wanted.scale * wanted.size_m
    if wanted.target is None:
        return Face((size_m, size_m), wanted.subject, face_corners_in_object(size_m))
    target = load_calibration(TargetCalibration, wanted.target)
    corners = target.corners
    shown = (float(np.linalg.norm(corners[1] - corners[0])), float(np.linalg.norm(corners[3] - corners[0])))
    return Face(shown, target.subject, corners)
