"""Makes a data set from a scan: the posed images that scanning software wrote."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace
from pathlib import Path

import numpy as np

from advnerf_core.data.epipolar import require_agreeing_poses
from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import SUFFIXES, read_bytes, size_of, write_image
from advnerf_core.data.posed_image import PosedImage
from advnerf_core.data.similarity import extent
from advnerf_core.data.view_loading import read_valid
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Pinhole
from calibration.photo_model import MIN_IMAGES, LeftOut, Model, Registered
from calibration.scans.reading import read_scan
from calibration.scans.scan import Picture, Scan, ScanError, ScanOptions
from nodes.lab.importing.data_set import Facts, write_model_set
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.importing.media import IMAGES
from nodes.lab.importing.metric import OwnScale, place, undistorted_views
from nodes.lab.importing.metric_options import MetricOptions
from nodes.lab.importing.staging import MASKS, build_beside
from nodes.runtime.progress import Report

_READING_SHARE = 0.1
# Sizes of reduced images are rounded to whole pixels.
_ROUNDING_PX = 1.0


def from_scan(path: Path, output: Path, options: ScanOptions, metric: MetricOptions, report: Report) -> Facts:
    """Make an upright data set with the poses and lenses of a scan.

    Args:
        path: Folder or file of the scan.
        output: Folder of the data set, with copies of the images.

    Raises:
        AdvnerfError: The scan cannot be used.
    """

    def build(folder: Path) -> Facts:
        report(0.0, "reading the scan")
        kind, scan = read_scan(path, options)
        made = {folder.resolve(), output.resolve()}
        kept, pictures = _copy_images(
            scan, path, folder, made, lambda share, text="": report(_with_reading(share), text)
        )
        require_agreeing_poses(
            [
                PosedImage(folder / each.name, each.pinhole, each.lens, np.asarray(each.T_world_from_camera))
                for each in sorted(kept.images, key=lambda image: image.name)
            ],
            str(path),
        )
        similarity, facts = place(
            scan.model,
            scan.points_by_id,
            lambda: undistorted_views(kept, folder),
            metric,
            OwnScale(1.0, "poses" if scan.metric else None, scan.unit),
            scan.R_upright_from_scan,
        )
        facts = {
            "scan": {"format": kind, **scan.facts},
            "model": kept.summary(),
            "T_world_from_scan": similarity.T_target_from_source.tolist(),
            "metres_per_unit": similarity.scale,
            **facts,
        }
        poses, points = similarity.poses(kept.poses), similarity.points(kept.points)
        return write_model_set(folder, kept, poses, points, facts, pictures, similarity.points(scan.reached))

    if path.resolve() == output.resolve():
        raise ImportRecordingError(
            f"expected an --output that is not the scan itself, got {output}; give another folder"
        )
    inputs = [path, options.images, options.calibration, metric.positions]
    return build_beside(output, inputs, build, resumes=False)


def _with_reading(share: float) -> float:
    return _READING_SHARE + (1.0 - _READING_SHARE) * share


def _copy_images(
    scan: Scan, path: Path, folder: Path, made: Set[Path], report: Report
) -> tuple[Model, list[Picture]]:
    """The model of the readable images, with their names in the data set, and their pictures."""
    model, kept, left_out = scan.model, list[Registered](), list(scan.model.left_out)
    pictures = list[Picture]()
    for index, image in enumerate(model.images):
        picture = scan.pictures[image.name]
        try:
            copied = _copied(image, picture, folder)
        except (DatasetError, ScanError) as error:
            left_out.append(LeftOut(image.name, str(error)))
        else:
            kept.append(copied)
            pictures.append(picture)
        report((index + 1) / len(model.images), f"{index + 1} of {len(model.images)} images copied")
    left_out += [LeftOut(name, "--most leaves it out") for name in sorted(scan.thinned)]
    known = {*scan.pictures, *(each.name for each in left_out)}
    left_out += [LeftOut(name, "it has no pose in the scan") for name in _others(scan.folder, known, made)]
    if len(kept) < MIN_IMAGES:
        raise ImportRecordingError(
            f"expected at least {MIN_IMAGES} readable images of {path}, got {len(kept)}; {left_out[0].name}: {left_out[0].why}"
        )
    found = replace(model, images=tuple(kept), left_out=tuple(left_out))
    if extent(found.poses[:, :3, 3]) <= 0.0:
        raise ImportRecordingError(
            f"{path}: expected images from different places, got all from one; move the camera instead of only turning it"
        )
    return found, pictures


def _others(images: Path | None, known: set[str], made: Set[Path]) -> list[str]:
    """Images in the folder that the scan does not contain, except for data sets inside the folder."""
    if images is None:
        return []
    names = (
        file.relative_to(images).as_posix()
        for file in images.rglob("*")
        if file.suffix.lower() in SUFFIXES and file.is_file() and made.isdisjoint(file.resolve().parents)
    )
    return sorted(set(names) - {name.replace("\\", "/") for name in known})


def _copied(image: Registered, picture: Picture, folder: Path) -> Registered:
    """Store an image: its file unchanged, or the pixels that replace it.

    Raises:
        DatasetError: The image or its mask cannot be used.
        ScanError: The image has another shape.
    """
    name = f"{IMAGES}/{picture.name}"
    copy = folder / name
    content = picture.content()
    size = size_of(content, image.name)
    write_atomically(copy, content)
    try:
        pinhole = _same_size(image, picture, size)
        if picture.edited is not None:
            pixels, pinhole = picture.edited()
            write_image(copy, pixels)
        if picture.mask is not None:
            read_valid(Path(picture.name), picture.mask, *size)
            write_atomically(folder / MASKS / f"{picture.name}.png", read_bytes(picture.mask))
    except (DatasetError, ScanError):
        copy.unlink(missing_ok=True)
        raise
    return replace(image, name=name, pinhole=pinhole)


def _same_size(image: Registered, picture: Picture, size: tuple[int, int]) -> Pinhole:
    """Intrinsics for the image in its current size, which may be smaller than the scan's.

    Raises:
        ScanError: The image has another shape.
    """
    width, height = size
    if size == (picture.width, picture.height):
        return image.pinhole
    factor = width / picture.width
    if factor >= 1.0 or abs(height - factor * picture.height) > _ROUNDING_PX:
        raise ScanError(
            f"{picture.name}: expected {picture.width} x {picture.height} pixels as camera {image.camera_id} of the scan has, got {width} x {height}; "
            "give the images that the poses belong to"
        )
    return image.pinhole.resized(width, height)
