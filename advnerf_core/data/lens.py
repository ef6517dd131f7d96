"""Lens distortion and its removal: loaded data sets have ideal pinholes only.

Two models, both as OpenCV defines them: ``OPENCV`` (Brown: radial k1, k2, k3 and tangential p1, p2, on the image plane) and
``OPENCV_FISHEYE`` (Kannala and Brandt 2006: a polynomial k1..k4 in the angle from the optical axis). COLMAP, nerfstudio and
Instant-NGP use the same two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.errors import DatasetError
from advnerf_core.geometry import Array, Pinhole

# An ideal pinhole that is wider spends nearly all its pixels on the border; a fisheye's view beyond is left out.
WIDEST_HALF_ANGLE_RAD = math.radians(70.0)
_EDGE_SAMPLES = 64
# OpenCV's maps end at 2^15; the largest sensors of phones have 200 million pixels.
LONGEST_PX, _MOST_PIXELS = 2**15 - 2, 2**28
_WIDEST_RAD = math.radians(130.0)  # no lens that is no fisheye has such a view


@dataclass(frozen=True)
class Lens:
    """Distortion of a lens relative to a pinhole.

    Attributes:
        coefficients: ``k1, k2, p1, p2, k3`` or, for a fisheye, ``k1, k2, k3, k4``.
        fisheye: Whether the coefficients belong to the fisheye model.
    """

    coefficients: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    fisheye: bool = False

    def __post_init__(self) -> None:
        expected = 4 if self.fisheye else 5
        if len(self.coefficients) != expected or not np.isfinite(self.coefficients).all():
            raise ValueError(f"expected {expected} finite distortion coefficients, got {self.coefficients}")

    @property
    def is_ideal(self) -> bool:
        """Whether it is a pinhole already; a fisheye never is, its zero coefficients mean an equidistant image."""
        return not self.fisheye and not any(self.coefficients)

    def distort(self, directions: Array, pinhole: Pinhole) -> Array:
        """Pixels ``[N, 2]`` (centres at +0.5) of directions ``[N, 3]`` in front of the camera."""
        points = np.ascontiguousarray(directions, dtype=np.float64).reshape(-1, 1, 3)
        matrix, zero = _opencv_matrix(pinhole), np.zeros(3)
        if self.fisheye:
            pixels, _ = cv2.fisheye.projectPoints(points, zero, zero, matrix, np.array(self.coefficients))
        else:
            pixels, _ = cv2.projectPoints(points, zero, zero, matrix, np.array(self.coefficients))
        return np.asarray(pixels, np.float64).reshape(-1, 2) + 0.5


@dataclass(frozen=True, eq=False)
class Straightening:
    """Undistortion of images of one camera.

    Attributes:
        pinhole: Intrinsics afterwards; the size is unchanged.
        valid: ``[H, W]`` bool: pixels that the lens saw; None if it saw all.
    """

    pinhole: Pinhole
    valid: NDArray[np.bool_] | None
    _maps: tuple[NDArray[np.float32], NDArray[np.float32]]

    def apply(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Undistort an image ``[H, W]`` or ``[H, W, C]``."""
        straight = cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(straight, np.uint8)


def require_size(width: int, height: int) -> None:
    """Refuse an image size [px] that no image can have here.

    Raises:
        DatasetError: A side is not above 0, or the image is too large.
    """
    if min(width, height) < 1 or max(width, height) > LONGEST_PX or width * height > _MOST_PIXELS:
        raise DatasetError(
            f"expected an image of at most {LONGEST_PX} px a side and {_MOST_PIXELS >> 20} million in all, and at least 1 px a side, got {width} x {height}; "
            "correct the size, or reduce the images"
        )


@lru_cache(maxsize=4)
def straightening(pinhole: Pinhole, lens: Lens, keep_all: bool = False) -> Straightening:
    """Find the pinhole that replaces a lens.

    Args:
        pinhole: Intrinsics of the distorted images.
        keep_all: Whether to keep every pixel of the image and mark the valid ones; otherwise the largest
            window without missing pixels is kept.

    Raises:
        DatasetError: The image is too large, or the coefficients fold it over itself, so that it cannot be undistorted.
    """
    require_size(pinhole.width, pinhole.height)
    ideal = _ideal_fisheye(pinhole, lens, keep_all) if lens.fisheye else _ideal_brown(pinhole, lens, keep_all)
    if ideal is None:
        raise _cannot_be_undone(pinhole, lens)
    matrix, new, size = _opencv_matrix(pinhole), _opencv_matrix(ideal), (pinhole.width, pinhole.height)
    build = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    maps = build(matrix, np.array(lens.coefficients), np.eye(3), new, size, cv2.CV_32FC1)
    x, y = (np.asarray(each, np.float32) for each in maps)
    slack_px = 1.5 + 0.005 * max(size)  # the window is found from samples of the border
    inside = (x > -slack_px) & (x < size[0] - 1 + slack_px) & (y > -slack_px) & (y < size[1] - 1 + slack_px)
    if not keep_all:
        if not inside.all():
            raise _cannot_be_undone(pinhole, lens)
        return Straightening(ideal, None, (x, y))
    valid = (x >= 0.0) & (x <= size[0] - 1) & (y >= 0.0) & (y <= size[1] - 1)
    if not valid.any():
        raise _cannot_be_undone(pinhole, lens)
    return Straightening(ideal, None if valid.all() else valid, (x, y))


def _ideal_brown(pinhole: Pinhole, lens: Lens, keep_all: bool) -> Pinhole | None:
    matrix, size = _opencv_matrix(pinhole), (pinhole.width, pinhole.height)
    ideal, _ = cv2.getOptimalNewCameraMatrix(matrix, np.array(lens.coefficients), size, float(keep_all))
    return _checked_pinhole(pinhole, ideal[0, 0], ideal[1, 1], ideal[0, 2], ideal[1, 2])


def _ideal_fisheye(pinhole: Pinhole, lens: Lens, keep_all: bool) -> Pinhole | None:
    """The window between the images of the four edges; their innermost points bound it, or their outermost."""
    widest = math.tan(WIDEST_HALF_ANGLE_RAD)
    limits = []
    for axis, at_end in ((0, False), (0, True), (1, False), (1, True)):
        values = _edge(pinhole, lens, axis, at_end)
        if not len(values):
            return None
        inner = float(values.min() if at_end else values.max())
        outer = float(values.max() if at_end else values.min())
        limits.append(float(np.clip(outer if keep_all else inner, -widest, widest)))
    left, right, top, bottom = limits
    if not (left < right and top < bottom):
        return None
    fx, fy = (pinhole.width - 1) / (right - left), (pinhole.height - 1) / (bottom - top)
    return _checked_pinhole(pinhole, fx, fy, -fx * left, -fy * top)


def _edge(pinhole: Pinhole, lens: Lens, axis: int, at_end: bool) -> Array:
    """Coordinate along ``axis`` on the image plane of the pixels of one edge of the distorted image."""
    size = (pinhole.width - 1.0, pinhole.height - 1.0)
    pixels = np.zeros((_EDGE_SAMPLES, 1, 2))
    pixels[:, 0, axis] = size[axis] if at_end else 0.0
    pixels[:, 0, 1 - axis] = np.linspace(0.0, size[1 - axis], _EDGE_SAMPLES)
    # Distance from the axis in focal lengths is the distorted angle; Newton's method gives the true one.
    matrix = _opencv_matrix(pinhole)
    plane = (pixels[:, 0] - matrix[:2, 2]) / matrix.diagonal()[:2]
    distorted = np.maximum(np.linalg.norm(plane, axis=1), 1e-12)
    k = np.array(lens.coefficients)
    angle = np.minimum(distorted, 0.5 * math.pi)
    for _ in range(30):
        powers = angle[:, None] ** np.array([2, 4, 6, 8])
        slope = 1.0 + (powers * k * np.array([3, 5, 7, 9])).sum(axis=1)
        slope = np.where(np.abs(slope) > 1e-3, slope, 1e-3)
        angle = np.clip(angle - (angle * (1.0 + powers @ k) - distorted) / slope, 0.0, math.pi)
    found = np.abs(angle * (1.0 + angle[:, None] ** np.array([2, 4, 6, 8]) @ k) - distorted) < 1e-6
    # Behind the image plane counts as infinitely far out: it bounds no window.
    radius = np.where(angle < math.radians(89.9), np.tan(np.minimum(angle, math.radians(89.9))), math.inf)
    if not found.any():
        return np.zeros(0)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.nan_to_num(radius * plane[:, axis] / distorted, posinf=1e9, neginf=-1e9))[found]


def _checked_pinhole(like: Pinhole, fx: float, fy: float, cx: float, cy: float) -> Pinhole | None:
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0.0 and fy > 0.0):
        return None
    return Pinhole(like.width, like.height, float(fx), float(fy), float(cx) + 0.5, float(cy) + 0.5)


def _opencv_matrix(pinhole: Pinhole) -> Array:
    matrix = pinhole.matrix.copy()
    matrix[:2, 2] -= 0.5  # OpenCV counts pixel centres from 0
    return matrix


def _cannot_be_undone(pinhole: Pinhole, lens: Lens) -> DatasetError:
    view = 2.0 * math.atan(0.5 * max(pinhole.width / pinhole.fx, pinhole.height / pinhole.fy))
    if not lens.fisheye and view > _WIDEST_RAD:
        return DatasetError(
            f"expected a focal length that fits the images, got a view of {math.degrees(view):.0f} degrees (fl_x {pinhole.fx:.1f} at "
            f"{pinhole.width} x {pinhole.height} px); correct w and h, or fl_x and fl_y: they must be of one size of the images"
        )
    kind = "OPENCV_FISHEYE k1, k2, k3, k4" if lens.fisheye else "OPENCV k1, k2, p1, p2, k3"
    return DatasetError(
        f"expected a distortion that can be undone over the whole image, got {kind} = "
        f"{', '.join(f'{c:.4g}' for c in lens.coefficients)} at {pinhole.width} x {pinhole.height}, fl_x {pinhole.fx:.1f}; "
        "no camera has such a lens, so its poses are doubtful too. Remove the frames of this camera from the file, or find its poses and lens "
        "again: `advnerf scene from-images FOLDER -o NEW_FOLDER` takes the simplest lens that fits and leaves out such cameras by name"
    )
