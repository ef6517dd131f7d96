"""Makes a data set from a model that COLMAP wrote and the images that it was made from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Set
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import SUFFIXES, image_size, read_bytes, read_stored, write_image
from advnerf_core.data.lens import straightening
from advnerf_core.data.similarity import Similarity
from advnerf_core.documents import read_csv
from advnerf_core.errors import ConfigError
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Array, Pinhole
from calibration.colmap_reading import ColmapModel, read_colmap, undistorted_image
from calibration.known_scale import View, fit_known_positions, length_scale, marker_scale
from calibration.photo_model import MIN_IMAGES, LeftOut, Model, Registered
from calibration.world_axes import find_ground, on_ground
from nodes.lab.importing.data_set import Imported, write_model_set
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.importing.media import IMAGES
from nodes.lab.importing.staging import build_beside
from nodes.runtime.progress import Report

_READING_SHARE = 0.1
# Sizes of reduced images are rounded to whole pixels.
_ROUNDING_PX = 1.0


@dataclass(frozen=True)
class ColmapConfig:
    """Settings of an import from COLMAP. At most one of ``length``, ``positions`` and ``marker_m`` gives the metre.

    Attributes:
        model: Name of the model's folder, if there are several; None for the one with the most images.
        length: Two images, or numbers of points, and the distance between them [m].
        positions: CSV file with known positions of cameras: ``image, x_m, y_m, z_m``, z up.
        marker_m: Side of printed markers [m].
        dictionary: OpenCV's name of the markers.
        up: ``ground``, ``cameras``, or ``auto`` for the ground if it is found.
    """

    model: str | None = None
    length: tuple[str, str, float] | None = None
    positions: Path | None = None
    marker_m: float | None = None
    dictionary: str = "DICT_APRILTAG_36h11"
    up: Literal["auto", "ground", "cameras"] = "auto"

    def __post_init__(self) -> None:
        given = [
            option
            for option, value in (
                ("--length", self.length),
                ("--positions", self.positions),
                ("--marker", self.marker_m),
            )
            if value is not None
        ]
        if len(given) > 1:
            raise ImportRecordingError(
                f"expected one source of the scale, got {' and '.join(given)}; give one of them"
            )


def from_colmap(model: Path, images: Path, output: Path, config: ColmapConfig, report: Report) -> Imported:
    """Make an upright data set with the poses and lenses of a COLMAP model.

    Args:
        model: Folder of the model, or of several.
        images: Folder of the images that the model was made from.
        output: Folder of the data set, with copies of the images.
    """

    def build(folder: Path) -> Imported:
        report(0.0, "reading the model")
        found = read_colmap(model, config.model)
        kept = _copy_images(
            found, images, folder, output, lambda share, text="": report(_with_reading(share), text)
        )
        similarity, facts = _place(found, lambda: _views(kept, folder), config)
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
    """The model of those images that are there, under the names that they have in the data set."""
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
    """The image in the folder; None if it is not there."""
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
    """Images in the folder that the model does not know; not those of data sets that are made inside it."""
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
    """Intrinsics for the image as it is: it may be smaller than the one that the model was made from.

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


def _place(
    found: ColmapModel, views: Callable[[], Iterable[View]], config: ColmapConfig
) -> tuple[Similarity, dict[str, Any]]:
    """The similarity into the data set's world, and what the report says of it."""
    model = found.model
    ground = None if config.up == "cameras" else find_ground(model.poses, model.points)
    if ground is None and config.up == "ground":
        raise ImportRecordingError(
            "expected a ground plane among the points below the cameras, found none; take photographs that show more of the ground, "
            "or give --up cameras"
        )
    up = "the cameras' up"
    if ground is not None:
        up = f"normal of the ground, a plane of {ground.points} points at z = 0"
    if config.positions is not None:
        positions = _read_positions(config.positions)
        fit = fit_known_positions(model, positions, ground)
        source = f"known positions of {fit.images} images ({len(positions)} in the file), rms {fit.rms_m:.3g} m, worst {fit.worst_m:.3g} m ({fit.worst})"
        return fit.similarity, _facts(
            "positions",
            source,
            up.removesuffix(" at z = 0") if fit.on_line else "that of the known positions",
            False,
        )
    scale, scale_from, source = 1.0, None, ""
    if config.length is not None:
        scale, scale_from = length_scale(found, *config.length), "length"
        source = f"{config.length[2]:g} m from {config.length[0]} to {config.length[1]}"
    elif config.marker_m is not None:
        markers = marker_scale(views(), config.marker_m, config.dictionary)
        scale, scale_from = markers.scale, "fiducials"
        source = f"{markers.markers} markers of {config.marker_m:g} m, whose sides differ by {100 * markers.spread:.2g} %"
    return on_ground(model, ground, scale), _facts(scale_from, source, up, ground is not None)


def _facts(scale_from: str | None, source: str, up: str, ground_at_zero: bool) -> dict[str, Any]:
    unknown = "unknown: lengths are in COLMAP's unit, not in metres; give --length, --positions or --marker"
    return {
        "scale": f"metric: {source}" if scale_from else unknown,
        "scale_from": scale_from,
        "up": up,
        "ground_at_zero": ground_at_zero,
    }


def _read_positions(file: Path) -> dict[str, Array]:
    positions: dict[str, Array] = {}
    for row in read_csv(file, ("image", "x_m", "y_m", "z_m")):
        name = row.values["image"].strip()
        if name in positions:
            raise ConfigError(
                f"{row.place}: image: expected each image once, got {name} again; remove one row"
            )
        positions[name] = np.array([row.number(column) for column in ("x_m", "y_m", "z_m")])
    return positions


def _views(model: Model, folder: Path) -> Iterator[View]:
    """Undistorted images with pinhole and pose."""
    for image in model.images:
        pixels = read_stored(folder / image.name)[0]
        if image.lens.is_ideal:
            yield pixels, image.pinhole, np.asarray(image.T_world_from_camera)
        else:
            straight = straightening(image.pinhole, image.lens)
            yield straight.apply(pixels), straight.pinhole, np.asarray(image.T_world_from_camera)
