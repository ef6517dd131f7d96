"""Finds photographs of another focal length among those of one camera: a zoom between them, which no EXIF data tell.

One lens for both takes up the difference by moving the cameras: poses and lens are then wrong at a small reprojection error. A bundle
adjustment with a lens for each image finds its focal length again, and how sure that is.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from calibration.lens_choice import FIRST_MODEL, adjust, images_of, set_model, typical_error_px
from calibration.photo_model import ReconstructionError

# Focusing changes a focal length by 1 to 3 %.
_LEAST_RATIO = 1.05
# In standard errors, which are themselves on the safe side; images that say less about their lens are not judged.
_SURE, _MOST_ERROR_PERCENT = 4.0, 3.0
_SHOWN = 5


@dataclass(frozen=True)
class OwnFocalLength:
    """The focal length that an image has for itself.

    Attributes:
        image: Name of the image.
        focal_px: Focal length [px].
        error_percent: Its standard error [%].
    """

    image: str
    focal_px: float
    error_percent: float


def own_focal_lengths(reconstruction: Any, held: Collection[int]) -> dict[int, list[OwnFocalLength]]:
    """Focal lengths of a model's images, each fitted with its own lens, by camera; the model itself is not changed.

    Args:
        held: Cameras whose intrinsics are known; they have no entry.
    """
    split, images = _split(reconstruction), images_of(reconstruction)
    constant = {image.image_id for number in images if number in held for image in images[number]}
    for number, camera in split.cameras.items():
        if number not in constant:
            set_model(camera, FIRST_MODEL)
    errors = adjust(split, constant, typical_error_px(split), with_errors=True)
    return {
        number: [
            OwnFocalLength(
                each.name, float(split.cameras[each.image_id].focal_length_x), errors[each.image_id]
            )
            for each in images[number]
            if each.image_id in errors
        ]
        for number in images
        if number not in held
    }


def require_one_focal_length(found: Mapping[str, Collection[OwnFocalLength]]) -> None:
    """Refuse a camera, by its name, some of whose images have another focal length than the others for sure.

    Raises:
        ReconstructionError: It has two focal lengths or more.
    """
    for camera, images in found.items():
        fewer, others = _two_groups([each for each in images if each.error_percent <= _MOST_ERROR_PERCENT])
        if fewer:
            names = ", ".join(sorted(each.image for each in fewer)[:_SHOWN])
            names += ", ..." if len(fewer) > _SHOWN else ""
            raise ReconstructionError(
                f"expected photographs of one focal length by camera {camera}, got {len(fewer)} of about {_mean_px(fewer):.0f} px ({names}) and "
                f"{len(others)} of about {_mean_px(others):.0f} px: was it zoomed? Put the photographs of each focal length into a folder of their own, "
                "without --one-camera"
            )


def _two_groups(
    images: Collection[OwnFocalLength],
) -> tuple[list[OwnFocalLength], list[OwnFocalLength]]:
    """Images on both sides of the largest gap between focal lengths, the fewer first; none if the gap is not sure."""
    ordered = sorted(images, key=lambda each: each.focal_px)
    if len(ordered) < 2:
        return [], []
    cut = int(np.argmax(np.diff(np.log([each.focal_px for each in ordered])))) + 1
    fewer, others = sorted((ordered[:cut], ordered[cut:]), key=len)
    one_px, other_px = _mean_px(fewer), _mean_px(others)
    different = abs(math.log(one_px / other_px)) > math.log(_LEAST_RATIO)
    sure = all(
        abs(math.log(each.focal_px / opposite_px)) > _SURE * each.error_percent / 100.0
        for group, opposite_px in ((fewer, other_px), (others, one_px))
        for each in group
    )
    return (fewer, others) if different and sure else ([], [])


def _mean_px(images: Collection[OwnFocalLength]) -> float:
    weights = [max(each.error_percent, 0.01) ** -2 for each in images]
    return float(np.exp(np.average(np.log([each.focal_px for each in images]), weights=weights)))


def _split(reconstruction: Any) -> Any:
    """A copy of a model in which each image has a camera of its own, with the image's number."""
    import pycolmap

    split = pycolmap.Reconstruction()
    cameras: Mapping[int, Any] = reconstruction.cameras
    for number, images in images_of(reconstruction).items():
        shared = cameras[number]
        for image in images:
            own = pycolmap.Camera(
                model=shared.model_name,
                width=shared.width,
                height=shared.height,
                params=shared.params,
                camera_id=image.image_id,
            )
            split.add_camera_with_trivial_rig(own)
            seen = pycolmap.Point2DList([pycolmap.Point2D(point.xy) for point in image.points2D])
            copied = pycolmap.Image(
                name=image.name, camera_id=image.image_id, image_id=image.image_id, points2D=seen
            )
            split.add_image_with_trivial_frame(copied, image.cam_from_world())
    for point in reconstruction.points3D.values():
        split.add_point3D(point.xyz, pycolmap.Track(list(point.track.elements)))
    return split
