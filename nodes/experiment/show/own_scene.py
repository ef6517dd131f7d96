"""Objects in a learned scene of a user's own: they need no building, and each gives the board that shows its face in the room."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from advnerf_core.attack.printing.frame import frame_around, whole_cells
from advnerf_core.attack.spaces.space import FaceMount, NamedObject
from advnerf_core.display import DisplayModel
from advnerf_core.fields.summed_levels import with_summed_levels
from advnerf_core.fields.voxel_grid import (
    VoxelGridObject,
    cube_face_object,
    face_corners_in_object,
    with_border,
)
from advnerf_core.geometry import Array
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.surface import sphere, unwrapped
from advnerf_core.objects.voxel.generators import GENERATORS
from advnerf_core.objects.voxel.mesh import stand
from advnerf_core.objects.voxel.model import load_object
from calibration.display_colour import DisplayCalibration
from calibration.schema import TargetCalibration, load_calibration
from nodes.experiment.engine.artefact import hash_of
from nodes.experiment.plan.object_kinds import BALL, CUBE, MADE_HERE_M, load_mesh_of
from nodes.experiment.plan.placed import FLAT, FaceConfig, MeshConfig, PlacedObject
from nodes.experiment.plan.space_config import MeshShapeConfig, MeshTextureConfig
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.objects import GENERATOR_OF

_BALL_M, _SLAB_M = 0.7, 0.01
_FINER = 8  # samples of a border along an edge of its cells


class OwnObject(NamedTuple):
    """An object as it stands in the scene, and its description in attack files."""

    field: VoxelGridObject | MeshField
    named: NamedObject


def own_objects(experiment: Experiment) -> list[OwnObject]:
    """The objects in the order of the experiment file, in their plain colours.

    Raises:
        MeshError, ObjectFileError: A file cannot be read.
    """
    return [_own_object(experiment, thing) for thing in experiment.objects]


def _own_object(experiment: Experiment, thing: PlacedObject) -> OwnObject:
    if thing.kind in FLAT:
        field: VoxelGridObject | MeshField = flat_object(experiment, thing)
    elif (wanted := _as_mesh(experiment, thing)) is not None:
        field, file_sha256 = _mesh(thing, wanted)
        if file_sha256:
            return OwnObject(field, NamedObject(thing.name, hash_of([field.sha256, file_sha256])))
    else:
        voxels = load_object(Path(thing.kind)).placed(thing.T_world_from_object, thing.scale)
        levels = thing.levels
        field = with_summed_levels(voxels, levels, finest=max(voxels.slots.shape)) if levels else voxels
    border = _border_of(experiment, thing)
    return OwnObject(field, NamedObject(thing.name, field.sha256, border and border[0]))


def flat_object(
    experiment: Experiment,
    thing: PlacedObject,
    T_world_from_face: Array | None = None,
    resolution: int | None = None,
) -> VoxelGridObject:
    """A panel or cube with a face: at its own pose or another one ``[4, 4]``, and with its own number of colours along an edge and its own border,
    or another number and no border."""
    face = thing.face or FaceConfig()
    of_all, own = experiment.config.object, resolution is None
    field = cube_face_object(
        face.size_m,
        resolution or _resolution(experiment, face),
        face.rgb or of_all.panel_rgb,
        thing.T_world_from_face if T_world_from_face is None else T_world_from_face,
        one_sided=thing.kind != CUBE,
        depth_m=face.size_m if thing.kind == CUBE else _SLAB_M,
    )
    if own and (border := _border_of(experiment, thing)) is not None:
        field = with_border(field, _drawn(experiment, thing, *border))
    return replace(field, scale=field.scale * thing.scale)


def _resolution(experiment: Experiment, face: FaceConfig) -> int:
    return face.resolution or experiment.config.object.panel_resolution


def _border_of(experiment: Experiment, thing: PlacedObject) -> tuple[float, int] | None:
    """Side of the markers in a print's border [m], and the cells across it; None without one."""
    face = thing.face
    if face is None or face.marker_m is None:
        return None
    return whole_cells(thing.side_m, _resolution(experiment, face), face.marker_m)


def _drawn(experiment: Experiment, thing: PlacedObject, marker_m: float, across: int) -> Array:
    """The border of a print as the camera sees it: one mean colour for each cell of the face's size ``[n, n, 3]``."""
    face = thing.face or FaceConfig()
    frame = frame_around((thing.side_m, thing.side_m), 0, marker_m)
    count = _resolution(experiment, face) + 2 * across
    at_m = (np.arange(count * _FINER) + 0.5) / (count * _FINER) * frame.sheet_m[0]
    inked = frame.drawn(at_m, at_m) / 255.0
    display, _ = _display_of(face)
    seen = inked if display is None else display.forward(inked)
    return np.asarray(seen.reshape(count, _FINER, count, _FINER, 3).mean(axis=(1, 3)))


def _as_mesh(experiment: Experiment, thing: PlacedObject) -> MeshConfig | None:
    space = experiment.config.space
    if thing.mesh is None and isinstance(space, (MeshTextureConfig, MeshShapeConfig)):
        return MeshConfig(texels=space.texels)
    return thing.mesh


def _mesh(thing: PlacedObject, wanted: MeshConfig) -> tuple[MeshField, str]:
    """A mesh at its place, and the hash of the files that it was read from; empty for a generated mesh."""
    if thing.kind == BALL:
        surface = sphere(0.5 * (wanted.height_m or _BALL_M), wanted.rgb)
    elif thing.kind in MADE_HERE_M:
        surface = stand(GENERATORS[GENERATOR_OF[thing.kind]](), height_m=wanted.height_m)
    else:
        surface = load_mesh_of(thing.kind, wanted.up, wanted.height_m, wanted.unit)
        for note in surface.notes:
            print(f"warning: {note}")
    field = MeshField(unwrapped(surface, wanted.texels), thing.T_world_from_object, thing.scale)
    return field, surface.sha256


def mount_of(experiment: Experiment) -> FaceMount | None:
    """The board that shows a face in the room: the first one that an object gives; None if no object gives one."""
    for number, thing in enumerate(experiment.objects):
        face = thing.face
        if face is None or (face.target is None and face.subject is None):
            continue
        if face.target is None:
            subject, corners = str(face.subject), face_corners_in_object(thing.side_m)
            return FaceMount(subject, (thing.side_m, thing.side_m), corners, number)
        target = load_calibration(TargetCalibration, face.target)
        corners = target.corners
        width_m, height_m = (float(np.linalg.norm(corners[end] - corners[0])) for end in (1, 3))
        return FaceMount(target.subject, (width_m, height_m), corners, number)
    return None


def display_of(experiment: Experiment) -> tuple[DisplayModel | None, float]:
    """The measured monitor or printer that shows the only object, and the cosine of a monitor's viewing angle; None without one."""
    return _display_of(experiment.objects[0].face)


def _display_of(face: FaceConfig | None) -> tuple[DisplayModel | None, float]:
    if face is None or face.display is None:
        return None, 1.0
    return load_calibration(DisplayCalibration, face.display).display, face.display_cos
