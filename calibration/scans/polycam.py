"""Reads Polycam's raw data: keyframes with ARKit's poses.

Format: https://github.com/PolyCam/polyform (README, "Polycam's data format"). ``t_00 .. t_23`` are the rows of the pose of an OpenGL camera
(x right, y up, z backward) in a world with y up, in metres. Corrected images are undistorted and belong to the corrected cameras.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.image_files import read_bytes, read_stored
from advnerf_core.data.lens import Lens
from advnerf_core.documents import read_json
from advnerf_core.errors import ConfigError
from advnerf_core.geometry import OPENGL_FROM_OPENCV, Pinhole
from calibration.photo_model import LeftOut, Registered
from calibration.scans.depth import DepthView, depth_points
from calibration.scans.scan import (
    UPRIGHT_FROM_Y_UP,
    Picture,
    Scan,
    ScanError,
    ScanOptions,
    images_in,
    model_of,
    pinhole_of,
    pose_of,
    spread,
)

OPTIONS = ("images",)
# Undistortion leaves black pixels at the border; nerfstudio cuts off 15 of 1024.
_BORDER_SHARE = 15 / 1024
_VALUES_PER_M, _FARTHEST_M = 1000.0, 5.0  # of the LiDAR's depth images


def read(path: Path, options: ScanOptions) -> Scan:
    """Read the keyframes; corrected ones if there are any.

    Raises:
        ScanError: Too few of them.
    """
    keyframes = path / "keyframes"
    corrected = all((keyframes / f"corrected_{each}").is_dir() for each in ("cameras", "images"))
    prefix = "corrected_" if corrected else ""
    files = sorted(
        (keyframes / f"{prefix}cameras").glob("*.json"), key=lambda each: (len(each.stem), each.stem)
    )
    images = options.images or keyframes / f"{prefix}images"
    digits = max((len(each.stem) for each in files), default=0)
    by_stem = {each.stem: each for each in images_in(images)}
    found, left_out, pictures, depths = list[Registered](), list[LeftOut](), dict[str, Picture](), []
    for file in (files[index] for index in spread(len(files), options.most)):
        image = by_stem.get(file.stem)
        try:
            if image is None:
                raise ScanError(f"{file}: expected its image {file.stem}.jpg in {images}, found none")
            one, picture, whole = _keyframe(file, image, corrected, digits)
        except (ScanError, ConfigError) as error:
            left_out.append(LeftOut(image.name if image else f"{file.stem}.jpg", str(error)))
            continue
        found.append(one)
        pictures[one.name] = picture
        depth, confidence = (keyframes / name / f"{file.stem}.png" for name in ("depth", "confidence"))
        depths.append(DepthView(depth, whole, one.T_world_from_camera, confidence))
    points = depth_points(depths, _VALUES_PER_M, _FARTHEST_M)
    kind = "corrected by Polycam" if corrected else "ARKit's; lens distortion is not corrected"
    model = model_of(found, left_out, path, points, kind)
    named = {by_stem[each.stem].name for each in files if each.stem in by_stem}
    thinned = frozenset(named - {*pictures, *(each.name for each in left_out)})
    return Scan(
        model, pictures, "metric: lengths of ARKit", True, UPRIGHT_FROM_Y_UP, folder=images, thinned=thinned
    )


def _keyframe(file: Path, image: Path, corrected: bool, digits: int) -> tuple[Registered, Picture, Pinhole]:
    """The image, its pixels, and the intrinsics of the whole image."""
    values = read_json(file)
    keys = [f"t_{row}{column}" for row in range(3) for column in range(4)]
    keys += ["width", "height", "fx", "fy", "cx", "cy"]
    if not isinstance(values, dict) or any(key not in values for key in keys):
        raise ScanError(
            f"{file}: expected the keys t_00 .. t_23, width, height, fx, fy, cx and cy; export the scan again"
        )
    T = pose_of([[values[f"t_{row}{column}"] for column in range(4)] for row in range(3)], str(file))
    whole = pinhole_of(values["width"], values["height"], [values[key] for key in keys[-4:]], str(file))
    pinhole, edited = whole, None
    if corrected:
        pinhole, edited = _without_border(whole), partial(_pixels_without_border, image, whole)
    one = Registered(image.name, "phone", T @ OPENGL_FROM_OPENCV, pinhole, Lens())
    name = f"{image.stem.zfill(digits)}{image.suffix}"  # in the order of time
    picture = Picture(name, partial(read_bytes, image), whole.width, whole.height, edited)
    return one, picture, whole


def _border_px(width: int) -> int:
    return round(_BORDER_SHARE * width)


def _without_border(pinhole: Pinhole) -> Pinhole:
    px = _border_px(pinhole.width)
    return pinhole.cropped(px, px, pinhole.width - 2 * px, pinhole.height - 2 * px)


def _pixels_without_border(image: Path, whole: Pinhole) -> tuple[NDArray[np.uint8], Pinhole]:
    rgb: NDArray[Any] = read_stored(image)[0]
    height, width = rgb.shape[:2]
    px = _border_px(width)
    return rgb[px : height - px, px : width - px], _without_border(whole.resized(width, height))
