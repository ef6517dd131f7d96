"""Loads one photograph: read, masked, undistorted, resized."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import OPAQUE, Grey, Rgb, read_mask, read_stored, unpremultiplied
from advnerf_core.data.lens import straightening
from advnerf_core.data.posed_image import PosedImage
from advnerf_core.geometry import Pinhole

# Sizes may differ from the listed ones (half-size copies), but not in their ratio: then the image is another one, or turned.
_ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True, eq=False)
class LoadedView:
    """One image in memory, undistorted.

    Attributes:
        rgb: ``[H, W, 3]`` uint8; meaningless where it is fully transparent.
        alpha: Opacity ``[H, W]`` uint8; None for a photograph.
        valid: ``[H, W]`` bool: pixels to learn from; None if all are valid.
    """

    rgb: Rgb
    alpha: Grey | None
    valid: NDArray[np.bool_] | None
    pinhole: Pinhole


def load_image(frame: PosedImage) -> tuple[Rgb, Pinhole]:
    """Colours and intrinsics of one image, undistorted; see `load_view`."""
    view = load_view(frame)
    return view.rgb, view.pinhole


def load_view(frame: PosedImage, size: tuple[int, int] | None = None, keep_all: bool = False) -> LoadedView:
    """Read one image, undistort it and resize it to ``size`` (width, height).

    Undistortion keeps the largest window without missing pixels, so intrinsics change a little with it; or with ``keep_all``
    everything, and ``valid`` marks the existing pixels.
    """
    rgb, alpha = read_stored(frame.path)
    height, width = rgb.shape[:2]
    pinhole = _pinhole_of_file(frame, width, height)
    valid = None if frame.mask is None else read_valid(frame.path, frame.mask, width, height)
    if not frame.lens.is_ideal:
        rgb, alpha, valid, pinhole = _straightened(frame, rgb, alpha, valid, pinhole, keep_all)
    if size is not None and size != (width, height):
        rgb, alpha = _resized(rgb, alpha, size)
        if valid is not None:
            # A partly masked pixel counts as masked.
            valid = _resize(np.where(valid, np.uint8(OPAQUE), np.uint8(0)), size) == OPAQUE
        pinhole = pinhole.resized(*size)
    return LoadedView(rgb, alpha, valid, pinhole)


def _pinhole_of_file(frame: PosedImage, width: int, height: int) -> Pinhole:
    listed = frame.pinhole
    if abs(listed.width * height / (listed.height * width) - 1.0) > _ASPECT_TOLERANCE:
        raise DatasetError(
            f"expected an image of the shape {listed.width} x {listed.height} (w x h) that is listed for it, got {frame.path} of "
            f"{width} x {height}; the stored pixels were turned, cropped or stretched after the poses were found"
        )
    return listed.resized(width, height)


def read_valid(image: Path, file: Path, width: int, height: int) -> NDArray[np.bool_]:
    """Pixels ``[H, W]`` of an image that its mask keeps.

    Raises:
        DatasetError: The mask cannot be read, has another size, or keeps nothing.
    """
    mask = read_mask(file)
    if mask.shape != (height, width):
        raise DatasetError(
            f"expected a mask of {width} x {height}, the size of {image}, got {file} of {mask.shape[1]} x {mask.shape[0]}"
        )
    if not mask.any():
        raise DatasetError(
            f"expected a mask with something that is not black, got {file}, which hides all of {image}; "
            "leave this frame out of the file, or make the mask again"
        )
    return np.asarray(mask > 0)


def _straightened(
    frame: PosedImage,
    rgb: Rgb,
    alpha: Grey | None,
    valid: NDArray[np.bool_] | None,
    pinhole: Pinhole,
    keep_all: bool,
) -> tuple[Rgb, Grey | None, NDArray[np.bool_] | None, Pinhole]:
    try:
        lens = straightening(pinhole, frame.lens, keep_all)
    except DatasetError as error:
        camera = f" (camera {frame.camera_id})" if frame.camera_id else ""
        raise DatasetError(f"{frame.path}{camera}: {error}") from error
    if alpha is not None:
        rgb, alpha = (lens.apply(plane) for plane in _premultiplied(rgb, alpha))
        rgb = unpremultiplied(rgb, alpha)
    else:
        rgb = lens.apply(rgb)
    if valid is not None:
        valid = lens.apply(np.where(valid, np.uint8(OPAQUE), np.uint8(0))) == OPAQUE
    if lens.valid is not None:
        valid = lens.valid if valid is None else valid & lens.valid
    return rgb, alpha, valid, lens.pinhole


def _resized(rgb: Rgb, alpha: Grey | None, size: tuple[int, int]) -> tuple[Rgb, Grey | None]:
    if alpha is None:
        return _resize(rgb, size), None
    rgb, alpha = (_resize(plane, size) for plane in _premultiplied(rgb, alpha))
    return unpremultiplied(rgb, alpha), alpha


def _resize(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    shrinks = size[0] <= image.shape[1] and size[1] <= image.shape[0]
    return np.asarray(
        cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), np.uint8
    )


def _premultiplied(rgb: Rgb, alpha: Grey) -> tuple[Rgb, Grey]:
    """Colours weighted by opacity: only these may be averaged, or hidden colours bleed into the edges."""
    return np.rint(rgb * (alpha[..., None] / np.float32(OPAQUE))).astype(np.uint8), alpha
