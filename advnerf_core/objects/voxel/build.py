"""Builds an object model from a mesh or from cut-out photographs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from advnerf_core.geometry import Array, Pinhole
from advnerf_core.objects.voxel.fit import fit_grids
from advnerf_core.objects.voxel.hull import visual_hull
from advnerf_core.objects.voxel.mesh import MeshError, SurfaceMesh
from advnerf_core.objects.voxel.model import ObjectModel
from advnerf_core.objects.voxel.pictures import PosedRgba
from advnerf_core.objects.voxel.rasterise import draw_mesh
from advnerf_core.objects.voxel.stages import fit_in_stages
from advnerf_core.objects.voxel.views import dome, viewing_lens
from advnerf_core.objects.voxel.voxelise import MAX_RESOLUTION, ObjectGrids, voxelise
from advnerf_core.render.cast_object import cast_object

Progress = Callable[[float, str], None]
FIT_VIEWS, FIT_PIXELS = 60, 160
HELD_OUT_VIEWS = 12
# Limits of a good fit to pictures; see `advice`.
POOR_DB, UNFINISHED_DB, GAP_DB = 20.0, 0.3, 6.0
# Shares of a mesh that its voxels may lose: without a warning, and at most.
THIN, LOST = 0.05, 0.5
# Rows drawn at once for a comparison: a whole picture of 800 x 800 takes as much memory as the pictures of a set.
_STRIP_ROWS = 64
# The held-out poses lie between the poses of the fit.
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
        resolution: Voxels along its longest side, 8 to 128.
        steps: Steps of the refinement; 0 leaves the geometry as voxelised.
        source: Origin of the mesh, stored in the model.
        progress: Called with the finished fraction and the current step.
    """
    told = progress or (lambda fraction, text: None)
    told(0.0, "voxelising")
    views = mesh_views(mesh, HELD_OUT_VIEWS, FIT_PIXELS, _HELD_OUT_PHASE)
    start, notes = _whole(mesh, views, resolution)
    grids = (
        start
        if steps == 0
        else fit_grids(mesh_views(mesh, FIT_VIEWS, FIT_PIXELS), start, steps, progress=told).grids
    )
    model = ObjectModel(name, grids)
    judged = Agreement.of(model, views)
    about = {
        "source": source or {},
        "resolution": resolution,
        "steps": steps,
        "triangles": mesh.triangle_count,
        "held_out_psnr_db": round(judged.psnr_db, 2),
        "held_out_object_psnr_db": round(judged.object_psnr_db, 2),
        "missing": round(judged.missing, 3),
        **({"notes": [*mesh.notes, *notes]} if mesh.notes or notes else {}),
        "software_version": version("advnerf"),
    }
    return ObjectModel(name, model.grids, about)


def _whole(mesh: SurfaceMesh, views: PosedRgba, resolution: int) -> tuple[ObjectGrids, list[str]]:
    """Voxels that hold a mesh, and what its user should know of them: sheets that no resolution holds are made about a voxel thick.

    Raises:
        MeshError: They lose most of it, and finer ones would not.
    """
    plain = voxelise(mesh, resolution)
    voxel_mm, missing = 1e3 * plain.voxel, _missing(plain, views)
    if missing <= LOST:
        return plain, []
    if _missing(voxelise(mesh, MAX_RESOLUTION), views) <= LOST:
        raise MeshError(
            f"expected voxels that hold the object, {resolution} along its longest side lose {missing:.0%} of it: one is {voxel_mm:.3g} mm, longer "
            "than the object's thinnest parts; raise --resolution"
        )
    thick = voxelise(mesh, resolution, thickened=True)
    if (missing := _missing(thick, views)) > LOST:
        raise MeshError(
            f"expected a mesh that voxels hold, {resolution} along its longest side lose {missing:.0%} of it, as would finer ones: its parts are thinner "
            "than a voxel; make them thicker, or attack the mesh itself"
        )
    return thick, [
        f"its sheets are thinner than a voxel, and were made about {voxel_mm:.3g} mm thick; raise --resolution for thinner ones"
    ]


def _missing(grids: ObjectGrids, views: PosedRgba) -> float:
    return Agreement.of(ObjectModel("voxels", grids), views).missing


def build_from_images(
    views: PosedRgba,
    name: str,
    resolution: int = 64,
    steps: int = 600,
    source: dict[str, Any] | None = None,
    progress: Progress | None = None,
    held_out: PosedRgba | None = None,
    max_seconds: float | None = None,
    coarse_to_fine: bool = False,
) -> ObjectModel:
    """Carve an object out of cut-out pictures, then fit density and colours.

    ``about`` gets the agreement with the pictures: ``train_psnr_db`` and ``held_out_psnr_db`` over whole pictures,
    ``train_object_psnr_db`` and ``held_out_object_psnr_db`` over the pixels of the object, and ``gain_db``, by which the error
    fell at the end. Keys of held-out pictures are missing if there are none.

    Args:
        resolution: Voxels along the longest side.
        source: Origin of the pictures, stored in the model.
        progress: Called with the finished fraction and the current step.
        held_out: Pictures that are not learned from. The agreement is measured on at most 12 of each set.
        max_seconds: Time limit of the fit [s].
        coarse_to_fine: Whether to fit smaller grids first, see `stages`.
    """
    told = progress or (lambda fraction, text: None)
    told(0.0, "carving")
    if coarse_to_fine:
        fit = fit_in_stages(views, resolution, steps, told, max_seconds)
    else:
        fit = fit_grids(views, visual_hull(views, resolution), steps, progress=told, max_seconds=max_seconds)
    model = ObjectModel(name, fit.grids)
    about: dict[str, Any] = {
        "source": source or {},
        "resolution": resolution,
        "steps": fit.steps,
        "pictures": len(views.images),
        "gain_db": round(fit.gain_db, 2),
        "software_version": version("advnerf"),
    }
    for which, pictures in (("train", views), ("held_out", held_out)):
        if pictures is None:
            continue
        told(1.0, f"comparing with {which.replace('_', '-')} pictures")
        judged = Agreement.of(model, _spread(pictures, HELD_OUT_VIEWS))
        about[f"{which}_psnr_db"] = round(judged.psnr_db, 2)
        about[f"{which}_object_psnr_db"] = round(judged.object_psnr_db, 2)
    return ObjectModel(name, model.grids, about)


def advice(about: Mapping[str, Any]) -> list[str]:
    """Problems of a built object with their remedies; empty if it is good.

    A mesh loses parts that are thinner than a voxel: a loss above ``THIN`` is reported. The other problems concern pictures.
    The figures refer to the object's own pixels. ``POOR_DB`` is an error of a tenth of the colour range: colours that an
    attack changes must be known better than that. A fit is unfinished if the error fell by more than ``UNFINISHED_DB`` over the
    last fifth of its steps, and overfitted if held-out pictures are worse by more than ``GAP_DB``, twice the error.
    """
    if about.get("missing", 0.0) > THIN:
        return [
            f"{about['missing']:.0%} of the object is lost: its thinnest parts are thinner than a voxel; raise --resolution"
        ]
    if "train_object_psnr_db" not in about:
        return []
    train_db, held_out_db = about["train_object_psnr_db"], about.get("held_out_object_psnr_db")
    found = []
    worst_db = train_db if held_out_db is None else min(train_db, held_out_db)
    if worst_db < POOR_DB:
        found.append(
            f"the object agrees poorly with its pictures: {worst_db:.1f} dB over its own pixels, expected at least {POOR_DB:.0f} dB"
        )
    if about["gain_db"] > UNFINISHED_DB:
        found.append(
            f"the fit is not finished: the error still fell by {about['gain_db']:.1f} dB over the last fifth of {about['steps']} "
            "steps; give more --steps or --minutes"
        )
    if held_out_db is not None and train_db - held_out_db > GAP_DB:
        found.append(
            f"held-out pictures agree worse than training pictures by {train_db - held_out_db:.1f} dB: take more pictures, "
            "and check that their poses and cut-outs are exact"
        )
    if found and len(found) == 1 and worst_db < POOR_DB:
        found.append("check poses and cut-outs first; then raise --resolution, and --steps with it")
    return found


def _spread(views: PosedRgba, most: int) -> PosedRgba:
    """At most ``most`` pictures, evenly spread over the set."""
    count = len(views.images)
    return views.chosen(np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)))


def mesh_views(mesh: SurfaceMesh, count: int, pixels: int, phase: float = 0.0) -> PosedRgba:
    """Pictures of a mesh from a dome around it."""
    poses, lens = dome(mesh.box, count, phase=phase), viewing_lens(pixels)
    return PosedRgba(draw_mesh(mesh, poses, lens), poses, (lens,) * count)


def draw_object(model: ObjectModel, T_object_from_camera: Array, pinhole: Pinhole) -> Array:
    """Premultiplied pictures ``[B, H, W, 4]`` of an object in its own colours."""
    field = model.placed(np.eye(4))
    assert field.plain_colours is not None
    colours = np.concatenate([field.plain_colours, field.fixed_colours])
    poses = np.asarray(T_object_from_camera).reshape(-1, 4, 4)
    pictures = np.zeros((len(poses), pinhole.height * pinhole.width, 4))
    for picture, pose in zip(pictures, poses, strict=True):
        cast = cast_object(field, pose[None], pinhole, 2, np.float64)
        picture[cast.pixels, :3] = cast.weights @ colours
        picture[cast.pixels, 3] = cast.alpha
    return pictures.reshape(len(poses), pinhole.height, pinhole.width, 4)


@dataclass(frozen=True)
class Agreement:
    """Agreement of an object with pictures, both before white.

    Attributes:
        psnr_db: PSNR over all pixels of the pictures [dB].
        object_psnr_db: PSNR over the pixels that the object covers, drawn or pictured [dB]. It does not depend on how much of a
            picture is empty.
        missing: Share of the pictured object that is not drawn, 0..1.
    """

    psnr_db: float
    object_psnr_db: float
    missing: float

    @classmethod
    def of(cls, model: ObjectModel, views: PosedRgba) -> Agreement:
        """Compare an object with pictures of it."""
        squares, pixels, covered, missing, pictured = 0.0, 0, 0, 0.0, 0.0
        for index, pinhole in enumerate(views.pinholes):
            image, pixels = views.picture(index), pixels + pinhole.width * pinhole.height
            for top in range(0, pinhole.height, _STRIP_ROWS):
                part = image[top : top + _STRIP_ROWS]
                strip = pinhole.cropped(0, top, pinhole.width, len(part))
                drawn = draw_object(model, views.T_object_from_camera[index], strip)[0]
                error = drawn[..., :3] - drawn[..., 3:] - (part[..., :3] - part[..., 3:])
                # Outside both silhouettes the error is zero: the sum is over the covered pixels.
                squares += float(np.square(error).sum())
                covered += int(((drawn[..., 3] > 0.0) | (part[..., 3] > 0.0)).sum())
                missing += float(np.maximum(part[..., 3] - drawn[..., 3], 0.0).sum())
                pictured += float(part[..., 3].sum())
        return cls(
            _psnr_db(squares, 3 * pixels), _psnr_db(squares, 3 * covered), missing / max(pictured, 1e-12)
        )


def _psnr_db(squares: float, count: int) -> float:
    return float(-10.0 * np.log10(max(squares / max(count, 1), 1e-12)))
