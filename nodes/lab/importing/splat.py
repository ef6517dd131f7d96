"""Makes a scene of a splat file: cleaned, upright and in metres."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.data.similarity import Similarity
from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.views import ImageSet, PosedImages
from advnerf_core.documents import read_json
from advnerf_core.files import refuse_overwriting
from advnerf_core.geometry import Array, make_transform
from advnerf_core.scene.metrics import psnr
from advnerf_core.splats.cleaning import Removed, central_box, clean
from advnerf_core.splats.gaussians import GaussianSplats
from advnerf_core.splats.reading import read_splats
from advnerf_core.splats.renderer import SplatRenderer
from advnerf_core.splats.scene_file import save_splat_scene
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.importing.splat_options import Axis, Point, SplatOptions
from nodes.lab.importing.staging import REPORT_FILE

# Rotations that take an axis of the file to z.
_TURNS: dict[Axis, list[list[float]]] = {
    "x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    "-x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
}
_COMPARED, _COMPARED_PX = 8, 200  # images, and their width
_LEAST_PSNR_DB = 14.0
# From a coin on a table to a town: beyond, the unit is wrong.
_SMALLEST_M, _LARGEST_M = 0.01, 10_000.0


@dataclass(frozen=True)
class ImportedSplat:
    """A scene file that was made.

    Attributes:
        count: Gaussians in it.
        removed: Those that were left out.
        box: Low and high corner [m].
        metres_per_unit: Length of the file's unit [m].
        psnr_db: Median agreement with the images it was trained on; None without images.
    """

    count: int
    removed: list[Removed]
    box: tuple[Point, Point]
    metres_per_unit: float
    psnr_db: float | None


def from_splat(file: Path, output: Path, options: SplatOptions) -> ImportedSplat:
    """Read, clean and place a splat, and write it as a scene file.

    Raises:
        SplatError: The file cannot be read or used.
        ImportRecordingError: The scale is unknown, or the splat does not show the images.
        PlaceError: The output is the splat, or a file of the images.
    """
    require_scale(file, options)
    listed = None if options.images is None else load_transforms(options.images)
    refuse_overwriting([file, *(listed.files if listed else ())], [output])
    splats, removed = clean(read_splats(file), not options.keep_floaters)
    psnr_db = None
    if options.images is not None and listed is not None:
        similarity, psnr_db = _placed_by_images(splats, options.images, listed, options.behind)
    else:
        similarity = _placed_by_hand(file, options)
    placed = splats.moved(similarity).ordered()
    low, high = central_box(placed)
    if not _SMALLEST_M <= (size_m := float((high - low).max())) <= _LARGEST_M:
        raise ImportRecordingError(
            f"expected a scene of {_SMALLEST_M:g} to {_LARGEST_M:g} m, got {size_m:.3g} m with {similarity.scale:g} m a unit; correct --metres-per-unit"
        )
    box = (options.box_low or _point(low), options.box_high or _point(high))
    if not all(a < b for a, b in zip(*box, strict=True)):
        raise ImportRecordingError(f"expected --box-low below --box-high, got {box[0]} and {box[1]}")
    if not ((placed.means_m >= box[0]) & (placed.means_m <= box[1])).all(axis=1).any():
        raise ImportRecordingError(
            f"expected a box with Gaussians in it, got {box[0]} to {box[1]}; nearly all are in {_point(low)} to {_point(high)}"
        )
    facts = {
        "file": file.name,
        "metres_per_unit": similarity.scale,
        "T_world_from_file": similarity.T_target_from_source.tolist(),
        "removed": {each.reason: each.count for each in removed},
        "psnr_to_images_db": psnr_db,
    }
    save_splat_scene(output, SplatRenderer(placed, options.behind, box=box), facts)
    return ImportedSplat(len(placed), removed, box, similarity.scale, psnr_db)


def require_scale(file: Path, options: SplatOptions) -> None:
    """Raise unless the length of a metre is known exactly once.

    Raises:
        ImportRecordingError: The scale is unknown, or given more than once.
    """
    if options.images is not None:
        given = {"--metres-per-unit": options.metres_per_unit, "--up": options.up, "--origin": options.origin}
        if both := [name for name, value in given.items() if value is not None]:
            raise ImportRecordingError(
                f"expected --images alone, which places the splat, got also {', '.join(both)}; leave them out"
            )
    elif options.metres_per_unit is None and file.suffix.lower() != ".glb":
        raise ImportRecordingError(
            f"expected a known length, as {file} has none: --images DATA_SET (of 'advnerf scene from-scan' with --length, --positions or "
            "--marker), or --metres-per-unit METRES (a known length in metres over its length in the file)"
        )


def _placed_by_hand(file: Path, options: SplatOptions) -> Similarity:
    up: Axis = options.up or ("y" if file.suffix.lower() in (".glb", ".spz") else "-y")
    turn, scale = np.array(_TURNS[up], np.float64), options.metres_per_unit or 1.0
    return Similarity(
        scale, make_transform(turn, -scale * turn @ np.array(options.origin or (0.0, 0.0, 0.0)))
    )


def _placed_by_images(
    splats: GaussianSplats, images: Path, listed: PosedImages, behind: Point
) -> tuple[Similarity, float]:
    """The similarity under which the splat shows the images best, and its median PSNR [dB]. Some tools turn y and z around."""
    frames = _frames(images)
    views = _views(listed)
    flips: list[Array] = [np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])]
    found = []
    for frame in frames:
        for flip in flips:
            similarity = frame.after(Similarity(1.0, flip))
            found.append((_agreement_db(SplatRenderer(splats.moved(similarity), behind), views), similarity))
    best_db, best = max(found, key=lambda pair: pair[0])
    if best_db < _LEAST_PSNR_DB:
        raise ImportRecordingError(
            f"expected a splat that shows the images of {images}, got a PSNR of {best_db:.1f} dB to them at best (at least {_LEAST_PSNR_DB:g}); give the "
            "images that it was trained on, in the frame it was trained in, or place it with --metres-per-unit, --up and --origin"
        )
    return best, best_db


def _frames(images: Path) -> list[Similarity]:
    """From the frames that a splat of these images may be trained in to the world: the scan's, COLMAP's, nerfstudio's scaled one, the world itself."""
    facts: dict[str, Any] = {}
    if (report := (images if images.is_dir() else images.parent) / REPORT_FILE).is_file():
        facts = read_json(report)
    if facts.get("scale_from") is None:
        got = (
            "one of unknown scale"
            if facts
            else f"one without {REPORT_FILE}, which says how its metres are known"
        )
        raise ImportRecordingError(
            f"expected a data set in metres at {images}, got {got}; make it with advnerf scene from-scan and --length, --positions or --marker"
        )
    world = Similarity(1.0, np.eye(4))
    if "T_world_from_scan" not in facts:
        return [world]
    world_from_scan = _similarity(facts["metres_per_unit"], facts["T_world_from_scan"])
    scan = facts.get("scan", {})
    trained = [
        world_from_scan.after(_similarity(scan[unit], scan[pose]))
        for unit, pose in (
            ("scan_units_per_dataparser_unit", "T_scan_from_dataparser"),
            ("scan_units_per_colmap_unit", "T_scan_from_colmap"),
        )
        if unit in scan
    ]
    return [world_from_scan, *trained, world]


def _similarity(scale: float, T_target_from_source: list[list[float]]) -> Similarity:
    return Similarity(float(scale), np.array(T_target_from_source, np.float64))


def _views(listed: PosedImages) -> list[ImageSet]:
    """A few of the images, small, each with its own lens."""
    chosen = np.unique(np.linspace(0, len(listed.frames) - 1, _COMPARED).astype(int))
    views = []
    for frame in (listed.frames[k] for k in chosen):
        height_px = max(1, round(_COMPARED_PX * frame.pinhole.height / frame.pinhole.width))
        views.append(listed.with_frames([frame]).load((_COMPARED_PX, height_px)))
    return views


def _agreement_db(renderer: SplatRenderer, views: list[ImageSet]) -> float:
    return float(
        np.median(
            [
                psnr(
                    renderer.render(each.T_world_from_camera, each.pinholes[0])[0][0].numpy(),
                    each.rgb[0] / 255.0,
                )
                for each in views
            ]
        )
    )


def _point(values: Array) -> Point:
    x, y, z = (round(float(value), 4) for value in values)
    return x, y, z
