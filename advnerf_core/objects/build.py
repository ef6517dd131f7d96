"""From a mesh or from cut-out photographs to an object model."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np

from advnerf_core.geometry import Array, Pinhole
from advnerf_core.objects.fit import PosedRgba, fit_grids
from advnerf_core.objects.hull import visual_hull
from advnerf_core.objects.mesh import SurfaceMesh
from advnerf_core.objects.model import ObjectModel
from advnerf_core.objects.rasterise import draw_mesh
from advnerf_core.objects.views import dome, viewing_lens
from advnerf_core.objects.voxelise import voxelise
from advnerf_core.render.cast_object import cast_object

Progress = Callable[[float, str], None]
FIT_VIEWS, FIT_PIXELS = 60, 160
HELD_OUT_VIEWS = 12
# The held-out poses lie between those of the fit.
_HELD_OUT_PHASE = 0.37


def build_from_mesh(
    mesh: SurfaceMesh,
    name: str,
    resolution: int = 64,
    steps: int = 400,
    source: dict[str, Any] | None = None,
    progress: Progress | None = None,
) -> ObjectModel:
    """Voxelise a mesh, then refine the grids on pictures drawn from it.

    Args:
        mesh: The mesh [m].
        name: What the object is called.
        resolution: Voxels along its longest side, 8 to 128.
        steps: Steps of the refinement; 0 leaves the geometry as voxelised.
        source: Where the mesh comes from, kept in the model.
        progress: Told the finished fraction and what is being done.
    """
    told = progress or (lambda fraction, text: None)
    told(0.0, "voxelising")
    start = voxelise(mesh, resolution)
    grids = (
        start
        if steps == 0
        else fit_grids(mesh_views(mesh, FIT_VIEWS, FIT_PIXELS), start, steps, progress=_steps(told, steps))
    )
    model = ObjectModel(name, grids)
    held_out = mesh_views(mesh, HELD_OUT_VIEWS, FIT_PIXELS, _HELD_OUT_PHASE)
    about = {
        "source": source or {}, "resolution": resolution, "steps": steps, "triangles": mesh.triangle_count,
        "held_out_psnr_db": round(agreement_db(model, held_out), 2), "software_version": version("advnerf"),
    }  # fmt: skip
    return ObjectModel(name, model.grids, about)


def build_from_images(
    views: PosedRgba,
    name: str,
    resolution: int = 64,
    steps: int = 600,
    source: dict[str, Any] | None = None,
    progress: Progress | None = None,
) -> ObjectModel:
    """Carve an object out of cut-out pictures, then fit density and colours. Every eighth picture is held out."""
    told = progress or (lambda fraction, text: None)
    told(0.0, "carving")
    kept = np.arange(len(views.images)) % 8 != 0 if len(views.images) >= 16 else np.ones(len(views.images), dtype=bool)
    training = _some(views, kept)
    grids = fit_grids(training, visual_hull(training, resolution), steps, progress=_steps(told, steps))
    model = ObjectModel(name, grids)
    about: dict[str, Any] = {
        "source": source or {}, "resolution": resolution, "steps": steps, "pictures": int(kept.sum()),
        "software_version": version("advnerf"),
    }  # fmt: skip
    if not kept.all():
        about["held_out_psnr_db"] = round(agreement_db(model, _some(views, ~kept)), 2)
    return ObjectModel(name, model.grids, about)


def mesh_views(mesh: SurfaceMesh, count: int, pixels: int, phase: float = 0.0) -> PosedRgba:
    """Pictures of a mesh from a dome around it."""
    poses, lens = dome(mesh.box, count, phase=phase), viewing_lens(pixels)
    return PosedRgba(draw_mesh(mesh, poses, lens), poses, (lens,) * count)


def draw_object(model: ObjectModel, T_object_from_camera: Array, pinhole: Pinhole, supersample: int = 2) -> Array:
    """Premultiplied pictures ``[B, H, W, 4]`` of an object in its own colours."""
    field = model.placed(np.eye(4))
    assert field.plain_colours is not None
    colours = np.concatenate([field.plain_colours, field.fixed_colours])
    poses = np.asarray(T_object_from_camera).reshape(-1, 4, 4)
    pictures = np.zeros((len(poses), pinhole.height * pinhole.width, 4))
    for picture, pose in zip(pictures, poses, strict=True):
        cast = cast_object(field, pose[None], pinhole, supersample, np.float64)
        picture[cast.pixels, :3] = cast.weights @ colours
        picture[cast.pixels, 3] = cast.alpha
    return pictures.reshape(len(poses), pinhole.height, pinhole.width, 4)


def agreement_db(model: ObjectModel, views: PosedRgba) -> float:
    """PSNR against pictures, both before white, over all their pixels [dB]."""
    errors = []
    for image, pose, pinhole in zip(views.images, views.T_object_from_camera, views.pinholes, strict=True):
        drawn = draw_object(model, pose, pinhole)[0]
        errors.append(np.square(drawn[..., :3] - drawn[..., 3:] - (image[..., :3] - image[..., 3:])).mean())
    return float(-10.0 * np.log10(max(float(np.mean(errors)), 1e-12)))


def _steps(told: Progress, steps: int) -> Callable[[int, float], None]:
    return lambda step, error: told(step / steps, f"fitting, step {step}/{steps}, error {error:.4f}")


def _some(views: PosedRgba, chosen: Array) -> PosedRgba:
    pinholes = tuple(lens for lens, keep in zip(views.pinholes, chosen, strict=True) if keep)
    return PosedRgba(views.images[chosen], np.asarray(views.T_object_from_camera)[chosen], pinholes)
