"""Stage object: cars and hydrants as voxels; and all objects, panels too, at their places in the world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from advnerf_core.attack.search.textures import TRAINED_WITH
from advnerf_core.fields.colour_grid import colour_grid
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.fields.voxel_grid import VoxelGridObject, cube_face_object
from advnerf_core.geometry import Array
from advnerf_core.objects.voxel.build import build_from_mesh
from advnerf_core.objects.voxel.generators import GENERATORS
from advnerf_core.objects.voxel.mesh import SurfaceMesh, stand
from advnerf_core.objects.voxel.model import ObjectModel, load_object, save_object
from advnerf_core.scene.surrogate import BackgroundRenderer, Surrogate
from nodes.experiment.plan.object_kinds import MADE_HERE_M, PANEL, is_mesh, load_mesh_of, name_of
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.learned_scene import load_background
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import Report

GENERATOR_OF: dict[str, str] = {"small_car": "car", "hydrant": "hydrant"}


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write one object file for each kind, without places."""
    kinds = sorted({thing.kind for thing in experiment.config.objects} - {PANEL})
    for index, kind in enumerate(kinds):

        def progress(fraction: float, text: str, index: int = index, kind: str = kind) -> None:
            report((index + fraction) / len(kinds), f"{name_of(kind)}: {text}")

        if not object_file(experiment, kind).exists():
            save_object(object_file(experiment, kind), build(experiment, kind, progress))


def build(experiment: Experiment, kind: str, progress: Any = None) -> ObjectModel:
    """One kind of object: from its generator, from a user's mesh, or from a user's object file.

    Raises:
        MeshError, ObjectFileError: The user's file cannot be read.
    """
    wanted = experiment.config.object
    if is_mesh(kind):
        own, name = surface_of(kind), name_of(kind)
        source = {"mesh": name, "sha256": own.sha256}
        return build_from_mesh(own, name, wanted.mesh_resolution, wanted.fit_steps, source, progress)
    if kind not in MADE_HERE_M:
        return load_object(Path(kind))
    resolution = wanted.car_resolution if kind == "small_car" else wanted.hydrant_resolution
    source = {"generator": GENERATOR_OF[kind]}
    return build_from_mesh(surface_of(kind), kind, resolution, wanted.fit_steps, source, progress)


def surface_of(kind: str) -> SurfaceMesh:
    """The surface of a kind of solid object, upright: a user's mesh, or a generator's.

    Raises:
        ConfigError: The kind is a file of voxels, which have no surface.
        MeshError: The user's mesh cannot be read.
    """
    if is_mesh(kind):
        return load_mesh_of(kind)
    if kind not in GENERATOR_OF:
        raise ConfigError(
            f"expected a kind of object with a mesh, got the voxels of {name_of(kind)}; name the mesh that they were made of (.glb)"
        )
    return stand(GENERATORS[GENERATOR_OF[kind]]())


def object_file(experiment: Experiment, kind: str) -> Path:
    """File of a kind of object."""
    return experiment.stage_folder("object") / f"{name_of(kind).partition('.')[0]}.object.safetensors"


def placed_objects(experiment: Experiment) -> list[VoxelGridObject]:
    """The objects in the order of the experiment file, in their plain colours."""
    kinds = {thing.kind for thing in experiment.objects} - {PANEL}
    models = {kind: load_object(object_file(experiment, kind)) for kind in kinds}
    return [
        panel_object(experiment, thing.side_m, thing.T_world_from_face)
        if thing.kind == PANEL
        else models[thing.kind].placed(thing.T_world_from_object, thing.scale)
        for thing in experiment.objects
    ]


def panel_object(
    experiment: Experiment, side_m: float, T_world_from_face: Array | None = None
) -> VoxelGridObject:
    """A panel in its plain colour: opaque, visible from its front."""
    wanted = experiment.config.object
    return cube_face_object(side_m, wanted.panel_resolution, wanted.panel_rgb, T_world_from_face)


def describe(experiment: Experiment) -> list[dict[str, Any]]:
    """Names, places and free colours of the objects, as plain data."""
    things = zip(experiment.objects, placed_objects(experiment), strict=True)
    return [{**thing.model_dump(), "free_colours": field.free_count} for thing, field in things]


def surrogate_of(
    experiment: Experiment, objects: Sequence[ColouredObject], background: BackgroundRenderer | None = None
) -> Surrogate:
    """The learned scene as the policy's camera sees it; ``background`` if it is loaded already."""
    render = background or load_background(experiment)
    given = {}
    if experiment.given_scene is not None:
        given["depth_tolerance_m"] = experiment.named_world.config.depth_tolerance_m
    return Surrogate(render, experiment.view.pinhole, experiment.mount, objects, **given)


def random_textures(
    experiment: Experiment, objects: Sequence[ColouredObject], shape: tuple[int, ...]
) -> Callable[[np.random.Generator], torch.Tensor]:
    """Draws theta, of ``shape``, of objects for training, of the families in the section ``policy``."""
    sigma, families = experiment.config.attack.random_sigma, experiment.config.policy.families
    if families == ("random",):  # in the bits of all victims before there were other families
        return lambda rng: torch.from_numpy(sigma * rng.standard_normal(shape, dtype=np.float32))
    grids = [colour_grid(field) for field in objects]

    def draw(rng: np.random.Generator) -> torch.Tensor:
        family = TRAINED_WITH[families[rng.integers(len(families))]]
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        return sigma * torch.cat([family(grid, generator) for grid in grids]).reshape(shape)

    return draw
