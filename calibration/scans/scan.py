"""What a reader of a scan returns, and the checks that all readers share."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import SUFFIXES
from advnerf_core.data.lens import LONGEST_PX, Lens, straightening
from advnerf_core.data.rigid import rigid_pose
from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Array, Pinhole, require_camera
from calibration.photo_model import MIN_IMAGES, FoundCamera, LeftOut, Model, Registered

# Formats of recordings have an image every few hundredths of a second.
MOST_OF_RECORDING = 300


class ScanError(AdvnerfError):
    """A scan cannot be read. The message names the file, what was expected, what came and what to do."""


@dataclass(frozen=True)
class ScanOptions:
    """What a user may say about a scan.

    Attributes:
        images: Folder of the images; None for the format's own.
        model: Name of one of several COLMAP models; None for the largest.
        calibration: Calibration file of the camera, for formats without a lens.
        most: Largest number of images; None for all, or 300 of a recording.
    """

    images: Path | None = None
    model: str | None = None
    calibration: Path | None = None
    most: int | None = None


@dataclass(frozen=True)
class Picture:
    """The pixels of an image.

    Attributes:
        name: Name in the data set.
        content: Returns the content of the image file.
        width: Width of the file's image [px].
        height: Height of the file's image [px].
        edited: Returns pixels ``[H, W, 3]`` to store instead, and their intrinsics; None to store the file.
        mask: File whose black pixels do not count.
        split: ``train``, ``val`` or ``test``.
    """

    name: str
    content: Callable[[], bytes]
    width: int
    height: int
    edited: Callable[[], tuple[NDArray[np.uint8], Pinhole]] | None = None
    mask: Path | None = None
    split: str | None = None

    def __post_init__(self) -> None:
        """Raise for a name by which a file outside the data set would be written."""
        if ".." in PurePosixPath(self.name).parts or (self.mask is not None and self.name.startswith("/")):
            raise ScanError(
                f"expected images inside the folder of the scan, got one called {self.name!r:.120}; put it there, and correct its name in the scan"
            )


@dataclass(frozen=True, eq=False)
class Scan:
    """Posed images in the scan's own world.

    Attributes:
        model: Images, points and cameras.
        pictures: Pixels by the image's name in the model.
        unit: The unit of length, for the report.
        metric: Whether the unit is the metre.
        R_upright_from_scan: Rotation ``[3, 3]`` to z up, if the scan knows gravity; None otherwise.
        reached: Points ``[M, 3]`` around the content, for the box of a scan without points.
        points_by_id: Points ``[3]`` by COLMAP's number.
        folder: Folder whose other images are reported as left out, as they have no pose.
        thinned: Names of images of the scan that ``--most`` leaves out.
        facts: Further content of the report.
    """

    model: Model
    pictures: Mapping[str, Picture]
    unit: str
    metric: bool = False
    R_upright_from_scan: Array | None = None
    reached: Array = field(default_factory=lambda: np.zeros((0, 3)))
    points_by_id: Mapping[int, Array] = field(default_factory=dict)
    folder: Path | None = None
    thinned: frozenset[str] = frozenset()
    facts: Mapping[str, Any] = field(default_factory=dict)


# ARKit's worlds have y up; this turns their -z to y.
UPRIGHT_FROM_Y_UP: Array = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
UPRIGHT_FROM_Y_UP.setflags(write=False)


def pose_of(matrix: Any, where: str) -> Array:
    """A pose ``[4, 4]`` from numbers ``[3 or 4, 4]``.

    Raises:
        ScanError: They are no rotation and translation.
    """
    try:
        return rigid_pose(matrix)
    except ValueError as error:
        raise ScanError(f"{where}: {error}") from None


def pinhole_of(width: Any, height: Any, values: Sequence[Any], where: str) -> Pinhole:
    """Intrinsics from ``fx, fy, cx, cy`` [px], pixel centres at +0.5.

    Raises:
        ScanError: They are no numbers of a camera.
    """
    size = [number(each, where) for each in (width, height)]
    fx, fy, cx, cy = (number(each, where) for each in values)
    if min(*size, fx, fy) <= 0.0 or max(size) > LONGEST_PX or size != [int(each) for each in size]:
        raise ScanError(
            f"{where}: expected an image size and focal lengths above 0 px, got {size[0]:g} x {size[1]:g} and {fx:g}, {fy:g}; export the scan again"
        )
    try:
        return require_camera(Pinhole(int(size[0]), int(size[1]), fx, fy, cx, cy))
    except ValueError as error:
        raise ScanError(f"{where}: {error}") from None


def number(value: Any, where: str) -> float:
    """A finite number.

    Raises:
        ScanError: Not a finite number.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(float_of(value)):
        raise ScanError(f"{where}: expected a finite number, got {value!r:.60}; export the scan again")
    return float(value)


def float_of(value: float) -> float:
    """A number as a float; infinity for an integer that is too large."""
    try:
        return float(value)
    except OverflowError:
        return np.inf


def lens_of(pinhole: Pinhole, lens: Lens, where: str) -> Lens:
    """A lens whose distortion can be undone.

    Raises:
        ScanError: The lens cannot be undistorted.
    """
    try:
        straightening(pinhole, lens)
    except DatasetError as error:
        raise ScanError(f"{where}: {error}") from None
    return lens


def images_in(folder: Path) -> list[Path]:
    """Image files of a folder, by name."""
    inside = folder.iterdir() if folder.is_dir() else ()
    return sorted(each for each in inside if each.suffix.lower() in SUFFIXES and each.is_file())


def spread(count: int, most: int | None) -> list[int]:
    """Indices of at most ``most`` of ``count`` images, evenly spread."""
    if most is None or count <= most:
        return list(range(count))
    return [int(index) for index in np.linspace(0, count - 1, most).round()]


def model_of(
    images: Sequence[Registered],
    left_out: Sequence[LeftOut],
    where: Path,
    points: Array | None = None,
    why: str = "as in the scan",
) -> Model:
    """The model of a scan.

    Args:
        where: The scan, for errors.
        points: Points of the scene ``[M, 3]``.
        why: Source of the lenses.

    Raises:
        ScanError: Too few images.
    """
    if len(images) < MIN_IMAGES:
        first = f"; {left_out[0].name}: {left_out[0].why}" if left_out else ""
        raise ScanError(
            f"{where}: expected at least {MIN_IMAGES} images with a pose, got {len(images)}{first}; export the scan again, with its images"
        )
    name, count = Counter(each.name for each in images).most_common(1)[0]
    if count > 1:
        raise ScanError(
            f"{where}: expected each image once, got {name} {count} times; remove the other entries"
        )
    found = np.zeros((0, 3)) if points is None else points
    return Model(tuple(images), tuple(left_out), found, None, 1, _cameras(images, why))


def _cameras(images: Sequence[Registered], why: str) -> tuple[FoundCamera, ...]:
    by_camera = defaultdict[str, list[Registered]](list)
    for image in images:
        by_camera[image.camera_id].append(image)
    cameras = []
    for name, own in by_camera.items():
        shown = sorted(own, key=lambda each: each.pinhole.fx)[len(own) // 2]
        differ = any(each.pinhole != shown.pinhole for each in own)
        kind = "OPENCV_FISHEYE" if shown.lens.fisheye else "PINHOLE" if shown.lens.is_ideal else "OPENCV"
        text = f"{why}; each image has its own, the median is shown" if differ else why
        cameras.append(FoundCamera(name, len(own), kind, text, shown.pinhole, shown.lens, None))
    return tuple(cameras)
