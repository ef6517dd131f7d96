"""Meshes of a request: made and placed, their shapes as what a search changes, and the meshes that a search found."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from advnerf_core.attack.problem import Sensor
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.geometry import Array
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.shape import ShapeLimits, ShapeSensor
from advnerf_core.objects.mesh.surface import TexturedMesh, sphere, unwrapped
from advnerf_core.objects.voxel.generators import GENERATORS
from advnerf_core.objects.voxel.mesh import stand
from advnerf_core.objects.voxel.mesh_files import load_mesh
from advnerf_core.scene.surrogate import Surrogate, split_theta
from nodes.experiment.engine.artefact import hash_of
from nodes.experiment.node.mesh_request import MeshRequest, ShapeRequest


def mesh_field(wanted: MeshRequest, pose: Array, scale: float) -> tuple[MeshField, str]:
    """The object of a request, and its hash: of geometry and pose, and of the files that it was read from.

    Raises:
        MeshError: A file that is no mesh.
    """
    if wanted.file is not None:
        surface = load_mesh(wanted.file, wanted.up, wanted.height_m, wanted.unit)
        for note in surface.notes:
            print(f"warning: {note}")
    elif wanted.generate == "ball":
        surface = sphere(0.5 * (wanted.height_m or 0.7), wanted.rgb)
    else:
        surface = stand(GENERATORS[str(wanted.generate)](), height_m=wanted.height_m)
    field = MeshField(unwrapped(surface, wanted.texels), pose, scale)
    return field, hash_of([field.sha256, surface.sha256]) if surface.sha256 else field.sha256


def mesh_name(wanted: MeshRequest) -> str:
    """What it is called."""
    return str(wanted.generate) if wanted.file is None else wanted.file.name.partition(".")[0]


def shape_sensor(surrogate: Surrogate, wanted: ShapeRequest) -> ShapeSensor:
    """The sensor of an attack on shapes."""
    limits = ShapeLimits(wanted.bound_m, wanted.smoothness, wanted.samples, wanted.boundary_samples)
    return ShapeSensor(surrogate, limits)


def found_meshes(
    sensor: Sensor, objects: Sequence[ColouredObject], theta: Tensor
) -> list[TexturedMesh | None]:
    """The meshes that ``theta`` means, each in its own frame; None for an object that is none."""
    if isinstance(sensor, ShapeSensor):
        parts = split_theta(sensor.meshes, sensor.colours)
        shaped = zip(sensor.shaped(theta), parts, strict=True)
        return [each.mesh.with_texture(each.texture(part)) for each, part in shaped]
    return [
        field.mesh.with_texture(field.texture(part)) if isinstance(field, MeshField) else None
        for field, part in zip(objects, split_theta(objects, theta), strict=True)
    ]
