"""Reads COLMAP's models with pycolmap: poses, lenses and points of photographs."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.lens import Lens, straightening
from advnerf_core.files import natural_order
from advnerf_core.geometry import Array, Pinhole, require_camera
from calibration.colmap_files import check_binary_files, model_folders
from calibration.colmap_lens import lens_of, pinhole_of
from calibration.photo_model import MIN_IMAGES, FoundCamera, LeftOut, Model, ReconstructionError, Registered

_MIN_TRACK = 3


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A COLMAP model in its own world and unit.

    Attributes:
        model: Images, points and cameras. Cameras that no `Lens` describes have the pinhole of their undistorted images.
        folder: Folder of the model.
        sizes: Number of images with a pose, of every model found, by name.
        undistorted: pycolmap cameras whose images must be undistorted, by image name.
        points_by_id: Points ``[3]`` by COLMAP's number.
    """

    model: Model
    folder: Path
    sizes: dict[str, int]
    undistorted: dict[str, Any]
    points_by_id: dict[int, Array]


def read_colmap(path: Path, name: str | None = None) -> ColmapModel:
    """Read a COLMAP model: text or binary, with or without rigs and frames.

    Args:
        path: Folder of a model, or of several in subfolders.
        name: Name of the model; None for the one with the most images.

    Raises:
        ReconstructionError: The model does not exist, is damaged, or has too few images or an impossible camera.
    """
    folders = model_folders(path)
    if name is not None and name not in folders:
        raise ReconstructionError(f"{path}: expected --model to be one of {', '.join(folders)}, got {name}")
    found = {each: _read(folder) for each, folder in folders.items() if name in (None, each)}
    sizes = {each: model.num_reg_images() for each, model in found.items()}
    best = max(found, key=lambda each: (sizes[each], found[each].num_points3D()))
    return _converted(found[best], folders[best], sizes, len(folders))


def _read(folder: Path) -> Any:
    import pycolmap

    check_binary_files(folder)
    try:
        model = pycolmap.Reconstruction(folder)
        poses = [each.cam_from_world().matrix() for each in model.images.values() if each.has_pose]
        _require_names(model, folder)
    except (ValueError, IndexError, RuntimeError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise ReconstructionError(
            f"expected a COLMAP model that pycolmap can read in {folder}, got: {reason}; copy its files again, or export it again"
        ) from None
    if len(poses) < MIN_IMAGES or not np.isfinite(poses).all():
        got = "a pose that is not finite" if len(poses) >= MIN_IMAGES else str(len(poses))
        raise ReconstructionError(
            f"expected at least {MIN_IMAGES} images with a pose in {folder}, got {got}; give another model, or run COLMAP's mapper again"
        )
    return model


def _require_names(model: Any, folder: Path) -> None:
    """Names are bytes in COLMAP's files, and pycolmap decodes them when they are asked for; of a text file's it reads the part before a space."""
    try:
        counts = Counter(each.name for each in model.images.values())
    except UnicodeDecodeError as error:
        raise ReconstructionError(
            f"expected names of images in UTF-8 in {folder}, got {error.object!r}; copy its files again, or rename the images and run COLMAP again"
        ) from None
    for name, count in counts.most_common(1):
        if count > 1:
            raise ReconstructionError(
                f"expected each image of {folder} once, got {count} of the name {name!r}; names with spaces are cut in text files: give the binary "
                "model, or rename the images and run COLMAP again"
            )


def _converted(found: Any, folder: Path, sizes: dict[str, int], parts: int) -> ColmapModel:
    images = sorted(
        (each for each in found.images.values() if each.has_pose), key=lambda each: natural_order(each.name)
    )
    counts = Counter(each.camera_id for each in images)
    lenses = {number: _intrinsics(found.cameras[number], folder) for number in sorted(counts)}
    for number in lenses:
        _require_camera(found.cameras[number], folder)
    cameras = tuple(
        _found_camera(number, found.cameras[number], lenses[number], counts[number]) for number in lenses
    )
    points = {int(number): np.asarray(point.xyz) for number, point in sorted(found.points3D.items())}
    seen_well = [
        points[int(number)]
        for number, point in sorted(found.points3D.items())
        if point.track.length() >= _MIN_TRACK
    ]
    without = sorted(each.name for each in found.images.values() if not each.has_pose)
    model = Model(
        tuple(_registered(each, lenses) for each in images),
        tuple(LeftOut(name, "COLMAP found no pose for it") for name in without),
        np.array(seen_well, np.float64).reshape(-1, 3),
        float(found.compute_mean_reprojection_error()),
        parts,
        cameras,
    )
    # Copies: a camera of pycolmap belongs to its model, which ends here.
    undistorted = {
        each.name: copy.deepcopy(found.cameras[each.camera_id])
        for each in images
        if lens_of(found.cameras[each.camera_id]) is None
    }
    return ColmapModel(model, folder, sizes, undistorted, points)


def _registered(image: Any, lenses: Mapping[int, tuple[Pinhole, Lens]]) -> Registered:
    T = np.eye(4)
    T[:3] = image.cam_from_world().inverse().matrix()
    return Registered(image.name, str(image.camera_id), T, *lenses[image.camera_id])


def _found_camera(number: int, camera: Any, lens: tuple[Pinhole, Lens], count: int) -> FoundCamera:
    why = "as in the model" if lens_of(camera) else "no such lens here: its images are undistorted by COLMAP"
    return FoundCamera(str(number), count, camera.model_name, why, *lens, None)


def _require_camera(camera: Any, folder: Path) -> None:
    try:
        require_camera(pinhole_of(camera))
    except ValueError as error:
        raise ReconstructionError(
            f"{folder}: camera {camera.camera_id} ({camera.model_name}): {error}"
        ) from None


def _intrinsics(camera: Any, folder: Path) -> tuple[Pinhole, Lens]:
    """Intrinsics of the images in the data set.

    Raises:
        ReconstructionError: Images of such a camera cannot be undistorted.
    """
    import pycolmap

    try:
        pinhole, lens = lens_of(camera) or (
            pinhole_of(pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)),
            Lens(),
        )
        straightening(pinhole, lens)  # learning a scene does the same
    except (ValueError, RuntimeError, DatasetError) as error:
        reason = (str(error).splitlines() or [""])[0]
        advice = "undistort the images with COLMAP's image_undistorter and give the model that it writes"
        if camera.model_name == "EQUIRECTANGULAR":
            advice = "render perspective images from the panoramas and find the poses of those"
        raise ReconstructionError(
            f"{folder}: camera {camera.camera_id} ({camera.model_name}): expected a lens whose distortion can be undone, got: {reason}; {advice}"
        ) from None
    return pinhole, lens


def undistorted_image(file: Path, camera: Any) -> tuple[NDArray[np.uint8], Pinhole]:
    """Pixels ``[H, W, 3]`` of an image, which may be reduced, without the distortion of its pycolmap camera, and their intrinsics.

    Raises:
        DatasetError: The image cannot be read.
    """
    import pycolmap

    bitmap = pycolmap.Bitmap.read(file, True)
    if bitmap is None:
        raise DatasetError(f"{file}: expected an image that COLMAP can read; export it as PNG or JPEG")
    of_image = copy.deepcopy(camera)
    of_image.rescale(bitmap.width, bitmap.height)
    straight, ideal = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, of_image)
    return np.asarray(straight.to_array(), np.uint8), pinhole_of(ideal)
