"""Makes a data set from a model that COLMAP wrote and the images that it was made from."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import SUFFIXES, image_size, read_bytes, write_image
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Pinhole
from calibration.colmap_reading import ColmapModel, read_colmap, undistorted_image
from calibration.photo_model import MIN_IMAGES, LeftOut, Model, Registered
from nodes.lab.importing.data_set import Imported, write_model_set
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.importing.media import IMAGES
from nodes.lab.importing.metric import Unscaled, place, undistorted_views
from nodes.lab.importing.metric_options import MetricOptions
from nodes.lab.importing.staging import build_beside
from nodes.runtime.progress import Report

_READING_SHARE = 0.1
# Sizes of reduced images are rounded to whole pixels.
_ROUNDING_PX = 1.0


def from_colmap(
    model: Path, images: Path, output: Path, number: str | None, metric: MetricOptions, report: Report
) -> Imported:
    """Make an upright data set with the poses and lenses of a COLMAP model.

    Args:
        model: Folder of the model, or of several.
        images: Folder of the images that the model was made from.
        output: Folder of the data set, with copies of the images.
        number: Name of the model's folder, if there are several; None for the one with the most images.
        metric: Known facts about the world.
    """

    def build(folder: Path) -> Imported:
        report(0.0, "reading the model")
        found = read_colmap(model, number)
        kept = _copy_images(
            found, images, folder, output, lambda share, text="": report(_with_reading(share), text)
        )
        unknown = Unscaled(
            1.0,
            "unknown: lengths are in COLMAP's unit, not in metres; give --length, --positions or --marker",
        )
        similarity, facts = place(
            found.model, found.points_by_id, lambda: undistorted_views(kept, folder), metric, unknown
        )
        facts = {
            "structure_from_motion": kept.summary(),
            "colmap": {"model": str(found.folder), "images_by_model": found.sizes},
            "T_world_from_colmap": similarity.T_target_from_source.tolist(),
            "metres_per_unit": similarity.scale,
            **facts,
        }
        poses, points = similarity.poses(kept.poses), similarity.points(kept.points)
        return write_model_set(folder, kept, poses, points, facts)

    return build_beside(output, (images, model), build, resumes=False).moved_to(output)


def _with_reading(share: float) -> float:
    return _READING_SHARE + (1.0 - _READING_SHARE) * share


def _copy_images(found: ColmapModel, images: Path, folder: Path, output: Path, report: Report) -> Model:
    """The model of the existing images, with their names in the data set."""
    made = {folder.resolve(), output.resolve()}
    model, kept, left_out = found.model, list[Registered](), list(found.model.left_out)
    files = {each.name: _file_of(images, each.name) for each in model.images}
    _require_some(files, images)
    for index, image in enumerate(model.images):
        file = files[image.name]
        try:
            if file is None:
                raise DatasetError(f"it is not in {images}")
            kept.append(_copied(image, file, folder, found.undistorted.get(image.name)))
        except DatasetError as error:
            left_out.append(LeftOut(image.name, str(error)))
        report((index + 1) / len(model.images), f"{index + 1} of {len(model.images)} images copied")
    known = {*files, *(each.name for each in left_out)}
    left_out += [LeftOut(name, "it has no pose in the model") for name in _others(images, known, made)]
    if len(kept) < MIN_IMAGES:
        raise ImportRecordingError(
            f"expected at least {MIN_IMAGES} readable images in {images}, got {len(kept)}; {left_out[0].name}: {left_out[0].why}"
        )
    return replace(model, images=tuple(kept), left_out=tuple(left_out))


def _file_of(images: Path, name: str) -> Path | None:
    """The image in the folder; None if it does not exist."""
    for written in (PurePosixPath(name), PurePosixPath(name.replace("\\", "/"))):
        if written.is_absolute() or ".." in written.parts:
            raise ImportRecordingError(
                f"expected names of images inside {images}, the model has {name!r}; rename it in the model"
            )
        if (images / written).is_file():
            return images / written
    return None


def _require_some(files: dict[str, Path | None], images: Path) -> None:
    if any(files.values()):
        return
    first = next(iter(files))
    found = next((each for each in sorted(images.rglob(Path(first).name))), None)
    advice = "give the folder that the model was made from"
    if found is not None and found.as_posix().endswith(f"/{first}"):
        advice = f"give {found.as_posix().removesuffix(f'/{first}')}"
    raise ImportRecordingError(
        f"expected the model's {len(files)} images in {images}, none is there; the first is {first}; {advice}"
    )


def _others(images: Path, known: set[str], made: Set[Path]) -> list[str]:
    """Images in the folder that the model does not contain, except for data sets inside the folder."""
    names = (
        file.relative_to(images).as_posix()
        for file in images.rglob("*")
        if file.suffix.lower() in SUFFIXES and file.is_file() and made.isdisjoint(file.resolve().parents)
    )
    return sorted(set(names) - {name.replace("\\", "/") for name in known})


def _copied(image: Registered, file: Path, folder: Path, camera: Any) -> Registered:
    """Copy an image, without its distortion if there is a pycolmap camera to undo it.

    Raises:
        DatasetError: The image cannot be read.
    """
    name = f"{IMAGES}/{image.name.replace(chr(92), '/')}"
    if camera is not None:
        _same_size(image, file, Pinhole(camera.width, camera.height, 1.0, 1.0, 0.0, 0.0), exactly=True)
        write_image(folder / f"{name}.png", undistorted_image(file, camera))
        return replace(image, name=f"{name}.png")
    pinhole = _same_size(image, file, image.pinhole)
    write_atomically(folder / name, read_bytes(file))
    return replace(image, name=name, pinhole=pinhole)


def _same_size(image: Registered, file: Path, pinhole: Pinhole, exactly: bool = False) -> Pinhole:
    """Intrinsics for the image in its current size, which may be smaller than the model's.

    Raises:
        ImportRecordingError: The image has another shape.
    """
    width, height = image_size(file)
    if (width, height) == (pinhole.width, pinhole.height):
        return pinhole
    factor = width / pinhole.width
    if exactly or factor >= 1.0 or abs(height - factor * pinhole.height) > _ROUNDING_PX:
        raise ImportRecordingError(
            f"{file}: expected {pinhole.width} x {pinhole.height} pixels as camera {image.camera_id} of the model has, got {width} x {height}; "
            "give the images that the model was made from"
        )
    return pinhole.resized(width, height)
