"""Reads COLMAP models beside their images as scans."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath

from advnerf_core.data.image_files import read_bytes
from advnerf_core.data.scan_folder import colmap_models
from calibration.colmap_reading import ColmapModel, read_colmap, undistorted_image
from calibration.photo_model import LeftOut, Registered
from calibration.scans.scan import Picture, Scan, ScanError, ScanOptions, spread

OPTIONS = ("images", "model")
_UNKNOWN = "unknown: lengths are in COLMAP's unit, not in metres; give --length, --positions or --marker"


def read(path: Path, options: ScanOptions) -> Scan:
    """Read a model, a folder of models, or a project with ``images`` and ``sparse``.

    Raises:
        ReconstructionError: The model is damaged.
        ScanError: The images do not belong to the model.
    """
    models = colmap_models(path) or path
    found = read_colmap(models, options.model)
    images = options.images or _images_folder(path, models)
    files = {each.name: _file_of(images, each.name) for each in found.model.images}
    _require_some(files, images)
    kept, left_out, pictures = list[Registered](), list(found.model.left_out), dict[str, Picture]()
    for index in spread(len(found.model.images), options.most):
        image = found.model.images[index]
        file = files[image.name]
        if file is None:
            left_out.append(LeftOut(image.name, f"it is not in {images}"))
            continue
        kept.append(image)
        pictures[image.name] = _picture(found, image, file)
    model = replace(found.model, images=tuple(kept), left_out=tuple(left_out))
    facts = {"colmap": {"model": str(found.folder), "images_by_model": found.sizes}}
    thinned = frozenset(files) - {*pictures, *(each.name for each in left_out)}
    return Scan(
        model,
        pictures,
        _UNKNOWN,
        points_by_id=found.points_by_id,
        folder=images,
        thinned=thinned,
        facts=facts,
    )


def _picture(found: ColmapModel, image: Registered, file: Path) -> Picture:
    name, content = image.name.replace("\\", "/"), partial(read_bytes, file)
    camera = found.undistorted.get(image.name)
    if camera is None:
        return Picture(name, content, image.pinhole.width, image.pinhole.height)
    edited = partial(undistorted_image, file, camera)
    return Picture(f"{name}.png", content, int(camera.width), int(camera.height), edited)


def _images_folder(path: Path, models: Path) -> Path:
    beside = [folder / "images" for folder in (path, models.parent, models.parent.parent)]
    there = next((each for each in beside if each.is_dir()), None)
    if there is None:
        raise ScanError(
            f"{path}: expected the folder images beside the COLMAP model, found none; give the folder of its images with --images"
        )
    return there


def _file_of(images: Path, name: str) -> Path | None:
    """The image in the folder; None if it does not exist."""
    for written in (PurePosixPath(name), PurePosixPath(name.replace("\\", "/"))):
        if written.is_absolute() or ".." in written.parts:
            raise ScanError(
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
    advice = "give the folder that the model was made from with --images"
    if found is not None and found.as_posix().endswith(f"/{first}"):
        advice = f"give --images {found.as_posix().removesuffix(f'/{first}')}"
    raise ScanError(
        f"expected the model's {len(files)} images in {images}, none is there; the first is {first}; {advice}"
    )
