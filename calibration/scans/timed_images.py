"""Images with time stamps, placed by a trajectory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from advnerf_core.data.image_files import read_bytes
from advnerf_core.data.lens import Lens
from advnerf_core.geometry import Array, Pinhole
from calibration.photo_model import LeftOut, Registered
from calibration.scans.scan import MOST_OF_RECORDING, Picture, ScanError, ScanOptions, spread
from calibration.scans.trajectory import Trajectory


@dataclass(frozen=True)
class TimedImage:
    """An image file.

    Attributes:
        name: Name in the data set.
        file: The file, which may be missing.
        stamp_ns: Time of the image [ns].
    """

    name: str
    file: Path
    stamp_ns: int


@dataclass(frozen=True, eq=False)
class Placed:
    """Images with poses.

    Attributes:
        images: Images with poses.
        pictures: Pixels by name.
        stamps_ns: Times of the images [ns].
        left_out: Images without a pose or file.
    """

    images: list[Registered]
    pictures: dict[str, Picture]
    stamps_ns: list[int]
    left_out: list[LeftOut]


def place_images(
    timed: Sequence[TimedImage],
    trajectory: Trajectory,
    camera_id: str,
    intrinsics: Callable[[Path], tuple[Pinhole, Lens]],
    options: ScanOptions,
    T_body_from_camera: Array,
) -> Placed:
    """Give images the poses of a trajectory; evenly thinned to 300, or to ``options.most``.

    Args:
        trajectory: ``T_world_from_body``.
        intrinsics: Returns the intrinsics for an image file.

    Raises:
        ScanError: No image has a pose.
    """
    placed = Placed([], {}, [], [])
    with_pose = list[tuple[TimedImage, Array]]()
    for image in sorted(timed, key=lambda each: each.stamp_ns):
        T = trajectory.at(image.stamp_ns)
        if T is None:
            placed.left_out.append(LeftOut(image.name, f"no pose of {trajectory.file} is within 20 ms of it"))
        elif not image.file.is_file():
            placed.left_out.append(LeftOut(image.name, f"{image.file} is not there"))
        else:
            with_pose.append((image, T))
    if timed and not with_pose:
        if any(trajectory.at(each.stamp_ns) is not None for each in timed):
            raise ScanError(
                f"expected images of {trajectory.file}, got {len(timed)} names and none of the files; the first is {timed[0].file}; "
                "put them there, or give their folder with --images"
            )
        raise trajectory.without_images([each.stamp_ns for each in timed])
    for index in spread(len(with_pose), options.most or MOST_OF_RECORDING):
        image, T = with_pose[index]
        pinhole, lens = intrinsics(image.file)
        placed.images.append(Registered(image.name, camera_id, T @ T_body_from_camera, pinhole, lens))
        placed.pictures[image.name] = Picture(
            image.name, partial(read_bytes, image.file), pinhole.width, pinhole.height
        )
        placed.stamps_ns.append(image.stamp_ns)
    return placed
