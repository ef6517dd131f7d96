"""Meshes of a request: made and placed, their shapes as what a search changes, and the GLB files of what was found."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from advnerf_core.attack.artifact import AttackedObject
from advnerf_core.attack.problem import Sensor
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.geometry import Array
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.glb import write_glb
from advnerf_core.objects.mesh.shape import ShapeLimits, ShapeSensor
from advnerf_core.objects.mesh.surface import TexturedMesh, sphere, unwrapped
from advnerf_core.objects.voxel.generators import GENERATORS
from advnerf_core.objects.voxel.mesh import load_mesh, stand
from advnerf_core.scene.surrogate import Surrogate, split_theta
from nodes.experiment.request.mesh_request import MeshRequest, ShapeRequest


def mesh_field(wanted: MeshRequest, pose: Array, scale: float) -> MeshField:
    """The object of a request.

    Raises:
        MeshError: A file that is no mesh.
    """
    if wanted.file is not None:
        surface = load_mesh(wanted.file, wanted.up, wanted.height_m)
    elif wanted.generate == "ball":
        surface = sphere(0.5 * (wanted.height_m or 0.7), wanted.rgb)
    else:
        surface = stand(GENERATORS[str(wanted.generate)](), height_m=wanted.height_m)
    return MeshField(unwrapped(surface, wanted.texels), pose, scale)


def mesh_name(wanted: MeshRequest) -> str:
    """What it is called."""
    return str(wanted.generate) if wanted.file is None else wanted.file.name.partition(".")[0]


def shape_sensor(surrogate: Surrogate, wanted: ShapeRequest) -> ShapeSensor:
    """The sensor of an attack on shapes."""
    limits = ShapeLimits(wanted.bound_m, wanted.smoothness, wanted.samples, wanted.boundary_samples)
    return ShapeSensor(surrogate, limits)


def found_meshes(sensor: Sensor, objects: Sequence[ColouredObject], theta: Tensor) -> list[TexturedMesh | None]:
    """The meshes that ``theta`` means, each in its own frame; None for an object that is none."""
    if isinstance(sensor, ShapeSensor):
        parts = split_theta(sensor.meshes, sensor.colours)
        shaped = zip(sensor.shaped(theta), parts, strict=True)
        return [each.mesh.with_texture(each.texture(part)) for each, part in shaped]
    return [
        field.mesh.with_texture(field.texture(part)) if isinstance(field, MeshField) else None
        for field, part in zip(objects, split_theta(objects, theta), strict=True)
    ]


def write_meshes(attack_file: Path, names: Sequence[str], meshes: Sequence[TexturedMesh | None]) -> list[Path]:
    """Write ``<attack>.<number>_<name>.glb`` beside an attack file."""
    written = []
    for number, (name, mesh) in enumerate(zip(names, meshes, strict=True)):
        if mesh is not None:
            stem = attack_file.name.removesuffix(".attack.safetensors")
            written.append(attack_file.with_name(f"{stem}.{number}_{name}.glb"))
            write_glb(written[-1], mesh)
    return written


def shaped_objects(sensor: ShapeSensor, names: Sequence[str], theta: Tensor) -> tuple[AttackedObject, ...]:
    """What an attack file keeps of attacked shapes: the search's own parameters of each vertex, in the place of colours."""
    parts = theta.detach().split([len(each.mesh.vertices) for each in sensor.meshes])
    return tuple(
        AttackedObject(name, part.numpy().astype(np.float32), each.T_world_from_object, each.scale, each.sha256)
        for name, part, each in zip(names, parts, sensor.meshes, strict=True)
    )
