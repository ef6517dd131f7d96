"""Projection of an attacked face into a camera image, as in the deployment's compositor. numpy and OpenCV only.

Every sample of the image (``supersample^2`` a pixel) is traced to the face's plane, so clipping at the near plane and lens
distortion need no special cases; the samples are averaged over the pixel's area. The same face rendered by the surrogate looks
the same (tested).

With ``M = [right, down, corner]``, the face's edge vectors and its top left corner in the camera frame, a ray ``r = (x, y, 1)``
meets the plane at ``corner + a right + b down`` where ``(a w, b w, w) = M^-1 r`` and ``w`` is one over the planar depth.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.geometry import Array, Pinhole, transform_points
from advnerf_core.undistortion import ray_slopes

NEAR_M = 0.02  # as in the surrogate: anything nearer to the camera is not drawn
_CORNER_TOLERANCE_M = 0.02  # measured corners may be this far from a parallelogram; the nearest one is drawn
_EDGE_ON = 1e-4  # sine of the angle between ray and face below which the face is a line

Image = NDArray[np.uint8]


class FaceOverlay:
    """Draws one textured rectangle into the images of one camera.

    Args:
        texture: The face as displayed, ``[h, w, 3]`` uint8; row 0 on top and column 0 left for a viewer in front of it.
        corners_in_subject: Corners ``[4, 3]`` of the rectangle in the frame of the subject that carries it: top left, top
            right, bottom right, bottom left for that viewer [m].
        distortion: OpenCV distortion coefficients of the images, empty for none.
        supersample: Samples along each side of a pixel.
    """

    def __init__(
        self,
        texture: Image,
        corners_in_subject: ArrayLike,
        camera: Pinhole,
        distortion: tuple[float, ...] = (),
        supersample: int = 2,
    ) -> None:
        corners = np.asarray(corners_in_subject, dtype=np.float64)
        if (
            corners.shape != (4, 3)
            or np.abs(corners[0] + corners[2] - corners[1] - corners[3]).max() > _CORNER_TOLERANCE_M
        ):
            raise ValueError(f"expected the 4 corners of a rectangle in order, got {corners.tolist()}")
        if texture.ndim != 3 or texture.shape[2] != 3 or texture.dtype != np.uint8:
            raise ValueError(f"expected a texture [h, w, 3] uint8, got {list(texture.shape)} {texture.dtype}")
        if supersample < 1:
            raise ValueError(f"expected at least 1 sample along a pixel's side, got {supersample}")
        self._corners = _nearest_parallelogram(corners)
        self._camera = camera
        self._samples = supersample
        self._distorted = any(distortion)
        self._x, self._y = _sample_rays(camera, distortion, supersample)
        self._mips = [np.ascontiguousarray(texture)]
        while min(self._mips[-1].shape[:2]) >= 2:
            half = (max(self._mips[-1].shape[1] // 2, 1), max(self._mips[-1].shape[0] // 2, 1))
            self._mips.append(
                np.asarray(cv2.resize(self._mips[-1], half, interpolation=cv2.INTER_AREA), dtype=np.uint8)
            )

    def draw(self, image: Image, T_camera_from_subject: ArrayLike) -> tuple[Image, bool]:
        """Composite the face over an image.

        Args:
            image: ``[H, W, 3]`` uint8 of the camera; it is not changed.
            T_camera_from_subject: Pose ``[4, 4]`` of the subject in the camera frame (OpenCV axes).

        Returns:
            The image with the face and True; the unchanged image and False if the face is out of view or turned away.
        """
        if image.shape != (self._camera.height, self._camera.width, 3) or image.dtype != np.uint8:
            expected = f"[{self._camera.height}, {self._camera.width}, 3] uint8"
            raise ValueError(f"expected an image {expected}, got {list(image.shape)} {image.dtype}")
        corners = transform_points(T_camera_from_subject, self._corners)
        if not faces_camera(corners):
            return image, False
        window = self._window(corners)
        if window is None:
            return image, False
        return self._composite(image, corners, window)

    def shows_back(self, image: Image, T_camera_from_subject: ArrayLike) -> bool:
        """Whether the camera sees the back of the face, which is not drawn; arguments as of `draw`."""
        behind = transform_points(T_camera_from_subject, self._corners)[[1, 0, 3, 2]]
        window = self._window(behind) if faces_camera(behind) else None
        return window is not None and self._composite(image, behind, window)[1]

    def _window(self, corners: Array) -> tuple[int, int, int, int] | None:
        """First row, end row, first column, end column that hold the face; None if it is out of view."""
        height, width = self._camera.height, self._camera.width
        clipped = clip_near(corners)
        if len(clipped) == 0:
            return None
        if self._distorted or len(clipped) != 4 or (corners[:, 2] <= NEAR_M).any():
            return 0, height, 0, width
        uv = self._camera.project(clipped)
        left, top = np.floor(uv.min(axis=0)).astype(int)
        right, bottom = np.ceil(uv.max(axis=0)).astype(int)
        rows, columns = (max(top, 0), min(bottom, height)), (max(left, 0), min(right, width))
        if rows[0] >= rows[1] or columns[0] >= columns[1]:
            return None
        return (*rows, *columns)

    def _composite(
        self, image: Image, corners: Array, window: tuple[int, int, int, int]
    ) -> tuple[Image, bool]:
        top, bottom, left, right = window
        s = self._samples
        M = np.stack([corners[1] - corners[0], corners[3] - corners[0], corners[0]], axis=1)
        H = np.linalg.inv(M).astype(np.float32)
        rows, columns = slice(top * s, bottom * s), slice(left * s, right * s)
        x = self._x[rows if self._distorted else slice(None), columns]
        y = self._y[rows, columns if self._distorted else slice(None)]
        w = (H[2, 0] * x + H[2, 2]) + H[2, 1] * y
        inverse_w = 1.0 / np.where(w > 1e-9, w, np.float32(1e-9))
        a = ((H[0, 0] * x + H[0, 2]) + H[0, 1] * y) * inverse_w
        b = ((H[1, 0] * x + H[1, 2]) + H[1, 1] * y) * inverse_w
        inside = (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1) & (w > 1e-9) & (w < 1.0 / NEAR_M)
        mask = inside.astype(np.uint8) * np.uint8(255)
        covered = int(np.count_nonzero(inside))
        if covered == 0:
            return image, False
        texture = self._mip_for(covered)
        a *= np.float32(texture.shape[1])
        b *= np.float32(texture.shape[0])
        a -= np.float32(0.5)
        b -= np.float32(0.5)
        samples = cv2.remap(texture, a, b, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        samples[~inside] = 0
        size = (right - left, bottom - top)
        premultiplied = cv2.resize(samples, size, interpolation=cv2.INTER_AREA)
        alpha = cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
        out = image.copy()
        seen = cv2.multiply(out[top:bottom, left:right], cv2.merge([255 - alpha] * 3), scale=1.0 / 255.0)
        out[top:bottom, left:right] = cv2.add(seen, premultiplied)
        return out, True

    def _mip_for(self, covered_samples: int) -> Image:
        """The finest texture that is not finer than the samples that cover the face."""
        texels = self._mips[0].shape[0] * self._mips[0].shape[1]
        level = int(np.floor(0.5 * np.log2(max(texels / covered_samples, 1.0))))
        return self._mips[min(level, len(self._mips) - 1)]


def faces_camera(corners_in_camera: ArrayLike) -> bool:
    """Whether the front of a rectangle (corners ``[4, 3]``, clockwise for its viewer) is turned to the camera."""
    corners = np.asarray(corners_in_camera, dtype=np.float64)
    normal = np.cross(corners[3] - corners[0], corners[1] - corners[0])
    centre = corners.mean(axis=0)
    scale = float(np.linalg.norm(normal) * np.linalg.norm(centre))
    return float(-normal @ centre) > _EDGE_ON * scale


def clip_near(polygon_in_camera: ArrayLike, near_m: float = NEAR_M) -> Array:
    """The part of a convex polygon ``[N, 3]`` at planar depth above ``near_m``, ``[M, 3]``; M may be 0."""
    points = np.asarray(polygon_in_camera, dtype=np.float64)
    kept = []
    for start, end in zip(points, np.roll(points, -1, axis=0), strict=True):
        if start[2] > near_m:
            kept.append(start)
        if (start[2] > near_m) != (end[2] > near_m):
            fraction = (near_m - start[2]) / (end[2] - start[2])
            kept.append(start + fraction * (end - start))
    return np.array(kept).reshape(-1, 3)


def _nearest_parallelogram(corners: Array) -> Array:
    """Least squares fit; corners of a parallelogram are not changed."""
    right = 0.5 * (corners[1] - corners[0] + corners[2] - corners[3])
    down = 0.5 * (corners[3] - corners[0] + corners[2] - corners[1])
    first = corners.mean(axis=0) - 0.5 * (right + down)
    return np.stack([first, first + right, first + right + down, first + down])


def _sample_rays(
    camera: Pinhole, distortion: tuple[float, ...], s: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Ray slopes x and y of all samples: ``[1, W s]`` and ``[H s, 1]``, or both ``[H s, W s]`` with distortion."""
    u = (np.arange(camera.width * s) + 0.5) / s
    v = (np.arange(camera.height * s) + 0.5) / s
    if not any(distortion):
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        return x[None].astype(np.float32), y[:, None].astype(np.float32)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    # NaN where no ray arrives: such a sample is never inside a face.
    rays = ray_slopes(grid, camera.matrix, distortion).reshape(len(v), len(u), 2)
    return np.ascontiguousarray(rays[..., 0], np.float32), np.ascontiguousarray(rays[..., 1], np.float32)
