"""Converts camera images to policy images: undistort, crop, area resize. One function for every domain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Pinhole

# Image size of the policies that are trained here (Bojarski et al. 2016).
IMAGE_HEIGHT, IMAGE_WIDTH = 66, 200

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class PolicyView:
    """The window of the camera image that the policy sees, and its size.

    The defaults keep the full width of a 336x188 image and the rows around and under the horizon (row 63 with the camera
    pitched down 10 degrees) at PilotNet's aspect: two thirds of a board on the floor at 2 m are visible.

    Attributes:
        camera: Intrinsics of the (undistorted) camera image.
        crop_top_px: First row of the crop [px].
        crop_height_px: Number of rows of the crop [px].
        crop_left_px: First column of the crop [px].
        crop_width_px: Number of columns of the crop [px]; None extends to the right edge.
        width: Width of the policy's image [px].
        height: Height of the policy's image [px].
        distortion: OpenCV distortion coefficients of the camera; empty for a camera without distortion.
    """

    camera: Pinhole
    crop_top_px: int = 24
    crop_height_px: int = 111
    width: int = IMAGE_WIDTH
    height: int = IMAGE_HEIGHT
    distortion: tuple[float, ...] = ()
    crop_left_px: int = 0
    crop_width_px: int | None = None

    def __post_init__(self) -> None:
        _ = self.pinhole  # raises if the crop leaves the image
        if len(self.distortion) not in (0, 4, 5, 8):
            raise ValueError(f"expected 0, 4, 5 or 8 distortion coefficients, got {len(self.distortion)}")

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the crop: ``image[view.window]``."""
        width = self.camera.width - self.crop_left_px if self.crop_width_px is None else self.crop_width_px
        rows = slice(self.crop_top_px, self.crop_top_px + self.crop_height_px)
        return rows, slice(self.crop_left_px, self.crop_left_px + width)

    @cached_property
    def window_pinhole(self) -> Pinhole:
        """Intrinsics of the crop, before it is resized."""
        rows, columns = self.window
        width, height = columns.stop - columns.start, rows.stop - rows.start
        return self.camera.cropped(columns.start, rows.start, width, height)

    @cached_property
    def pinhole(self) -> Pinhole:
        """Intrinsics of the policy's image."""
        return self.window_pinhole.resized(self.width, self.height)

    def image(self, rgb: Image) -> Image:
        """Policy image ``[height, width, 3]`` uint8 of a camera image ``[camera.height, camera.width, 3]`` uint8 RGB."""
        expected = (self.camera.height, self.camera.width, 3)
        if rgb.shape != expected or rgb.dtype != np.uint8:
            raise ValueError(
                f"expected a uint8 image of shape {list(expected)}, got {rgb.dtype} {list(rgb.shape)}"
            )
        if self._undistortion is not None:
            rgb = np.asarray(
                cv2.remap(rgb, *self._undistortion, interpolation=cv2.INTER_LINEAR), dtype=np.uint8
            )
        resized = cv2.resize(rgb[self.window], (self.width, self.height), interpolation=cv2.INTER_AREA)
        return np.asarray(resized, dtype=np.uint8)

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which :meth:`from_dict` rebuilds the view."""
        return {**asdict(self), "distortion": list(self.distortion)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PolicyView:
        """Rebuild a view from :meth:`to_dict`."""
        try:
            values = {
                **data,
                "camera": Pinhole(**data["camera"]),
                "distortion": tuple(data.get("distortion", ())),
            }
            return cls(**values)
        except (KeyError, TypeError) as error:
            raise ValueError(
                f"expected a policy view as written by PolicyView.to_dict, got {data!r}"
            ) from error

    @cached_property
    def _undistortion(self) -> tuple[NDArray[Any], NDArray[Any]] | None:
        if not any(self.distortion):
            return None
        # OpenCV puts pixel centres at whole numbers, we put them at one half.
        matrix = self.camera.matrix - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
        size = (self.camera.width, self.camera.height)
        maps = cv2.initUndistortRectifyMap(
            matrix, np.array(self.distortion), np.eye(3), matrix, size, cv2.CV_32FC1
        )
        return maps[0], maps[1]
