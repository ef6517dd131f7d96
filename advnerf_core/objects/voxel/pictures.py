"""Pictures of an object with transparency, and batches of their rays.

Pictures stay in 8 bits: 100 of 800 x 800 are 256 MB. Rays are made for one batch of pixels at a time, never all at once.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.data.image_files import OPAQUE
from advnerf_core.data.lens import require_size
from advnerf_core.data.view_loading import LoadedView, load_view
from advnerf_core.data.views import PosedImages
from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Array, Pinhole, invert_transform, transform_points

_FEWEST = 3
# A picture's window contains the box's corners; less than one ray in this many meets the box only if the box is all but invisible.
_MOST_DRAWS = 200


class FitError(AdvnerfError, ValueError):
    """No object can be fitted to the pictures."""


@dataclass(frozen=True, eq=False)
class PosedRgba:
    """Pictures of an object with transparency.

    Attributes:
        images: Premultiplied ``[N, H, W, 4]``, float32 in 0..1 (drawn pictures) or uint8 in 0..255 (photographs).
        T_object_from_camera: ``[N, 4, 4]``, OpenCV axes.
    """

    images: NDArray[np.float32] | NDArray[np.uint8]
    T_object_from_camera: Array
    pinholes: tuple[Pinhole, ...]

    def __post_init__(self) -> None:
        count = len(self.T_object_from_camera)
        size = (self.pinholes[0].height, self.pinholes[0].width) if self.pinholes else (0, 0)
        if self.images.shape != (count, *size, 4) or len(self.pinholes) != count:
            raise FitError(
                f"expected {count} pictures {[*size, 4]} with as many intrinsics, "
                f"got {list(self.images.shape)} and {len(self.pinholes)}"
            )
        if self.images.dtype != np.uint8 and not np.isfinite(self.images).all():
            raise FitError("expected finite pixels and poses, got some that are not")
        if not np.isfinite(self.T_object_from_camera).all():
            raise FitError("expected finite pixels and poses, got some that are not")

    @property
    def white(self) -> float:
        """The value of a full channel: 1 or 255."""
        return float(OPAQUE) if self.images.dtype == np.uint8 else 1.0

    def picture(self, index: int) -> NDArray[np.float32]:
        """One picture, premultiplied ``[H, W, 4]`` float32 in 0..1."""
        return np.asarray(self.images[index], np.float32) / np.float32(self.white)

    def chosen(self, indices: Sequence[int] | NDArray[np.int64]) -> PosedRgba:
        """Some of the pictures."""
        at = np.asarray(indices, np.int64)
        images, poses = self.images[at], np.asarray(self.T_object_from_camera)[at]
        return PosedRgba(images, poses, tuple(self.pinholes[i] for i in at))

    def refuse_useless(self) -> None:
        """Raise for pictures that no object can be fitted to.

        Raises:
            FitError: Too few pictures, or all are empty.
        """
        if len(self.images) < _FEWEST:
            raise FitError(f"expected at least {_FEWEST} pictures around the object, got {len(self.images)}")
        if not self.images[..., 3].any():
            raise FitError("expected an object in the pictures, all of them are fully transparent")


def load_pictures(listed: PosedImages, size: tuple[int, int] | None = None) -> PosedRgba:
    """Read cut-out pictures of a data set into one array of bytes.

    Args:
        size: ``(width, height)`` [px] to resample all pictures to by area averaging; None keeps the size on disk.

    Raises:
        FitError: The pictures have no transparency, or differ in size.
        DatasetError: A picture cannot be read, or the size cannot be used.
    """
    frames = listed.frames
    if not frames:
        raise FitError(f"expected at least one picture in {listed.file}, got none")
    if size is not None:
        require_size(*size)
    first = load_view(frames[0], size)
    images = np.empty((len(frames), *first.rgb.shape[:2], 4), np.uint8)
    pinholes = [first.pinhole] * len(frames)
    cut_out = np.zeros(len(frames), np.bool_)

    def read(index: int) -> None:
        view = load_view(frames[index], size)
        if view.rgb.shape != first.rgb.shape:
            raise FitError(
                f"expected pictures of one size, got {_size(first)} in {listed.name_of(frames[0])} and {_size(view)} in "
                f"{listed.name_of(frames[index])}; give --size WIDTH HEIGHT to bring them to one"
            )
        _write_premultiplied(view, images[index])
        pinholes[index], cut_out[index] = view.pinhole, view.alpha is not None

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(read, range(len(frames))))
    if not cut_out.any():
        raise FitError(
            f"expected pictures with transparency in {listed.file}, all are opaque: cut the object out first"
        )
    return PosedRgba(images, np.stack([frame.T_world_from_camera for frame in frames]), tuple(pinholes))


def _size(view: LoadedView) -> str:
    return f"{view.pinhole.width} x {view.pinhole.height}"


def _write_premultiplied(view: LoadedView, out: NDArray[np.uint8]) -> None:
    alpha = np.full(view.rgb.shape[:2], OPAQUE, np.uint8) if view.alpha is None else view.alpha
    share = alpha[..., None].astype(np.float32) / np.float32(OPAQUE)
    out[..., :3] = np.rint(view.rgb * share)
    out[..., 3] = alpha


class RayBatches:
    """Draws random rays that meet a box, with their pixels.

    All rays that meet the box are equally likely. Pixels are drawn from the rectangle that the box's corners span in each picture;
    rays that miss the box are dropped.

    Args:
        low: Low corner of the box ``[3]`` [m].
        high: High corner ``[3]`` [m].

    Raises:
        FitError: No picture looks at the box.
    """

    def __init__(self, views: PosedRgba, low: Array, high: Array, seed: int = 0) -> None:
        self._views, self._rng = views, np.random.default_rng(seed)
        self._low, self._high = (torch.tensor(corner, dtype=torch.float32) for corner in (low, high))
        self._poses = np.asarray(views.T_object_from_camera, np.float64)
        self._lenses = np.array([[p.fx, p.fy, p.cx, p.cy] for p in views.pinholes])
        pairs = zip(self._poses, views.pinholes, strict=True)
        self._windows = np.array([_window(pose, pinhole, low, high) for pose, pinhole in pairs])
        sides = self._windows[:, 2:] - self._windows[:, :2]
        self._ends = np.cumsum(sides[:, 0] * sides[:, 1])
        if self._ends[-1] == 0:
            raise _looks_elsewhere()

    def draw(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Draw ``count`` rays.

        Returns:
            Premultiplied pixels ``[count, 4]`` in 0..1, ray origins and unit directions ``[count, 3]`` in the object's frame.
        """
        parts: list[tuple[Tensor, Tensor, Tensor]] = []
        missing = count
        for _ in range(_MOST_DRAWS):
            part = self._meeting(2 * missing)
            parts.append(tuple(values[:missing] for values in part))  # type: ignore[arg-type]
            missing -= len(parts[-1][0])
            if missing == 0:
                pixels, origins, directions = (torch.cat(values) for values in zip(*parts, strict=True))
                return pixels, origins, directions
        raise _looks_elsewhere()

    def _meeting(self, tries: int) -> tuple[Tensor, Tensor, Tensor]:
        at = self._rng.integers(0, self._ends[-1], tries)
        image = np.searchsorted(self._ends, at, side="right")
        left, top, right, _ = self._windows[image].T
        rest = self._ends[image] - 1 - at
        column, row = left + rest % (right - left), top + rest // (right - left)
        fx, fy, cx, cy = self._lenses[image].T
        seen = np.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, np.ones(tries)], axis=-1)
        seen /= np.linalg.norm(seen, axis=-1, keepdims=True)
        poses = self._poses[image]
        directions = torch.from_numpy(np.einsum("nij,nj->ni", poses[:, :3, :3], seen)).float()
        origins = torch.from_numpy(poses[:, :3, 3]).float()
        near, far = crossing(origins, directions, self._low, self._high)
        meets = far > near
        kept = meets.numpy()
        pixels = self._views.images[image[kept], row[kept], column[kept]].astype(np.float32) / np.float32(
            self._views.white
        )
        return torch.from_numpy(pixels), origins[meets], directions[meets]


def _window(
    T_object_from_camera: Array, pinhole: Pinhole, low: Array, high: Array
) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the pixels that may show the box; the whole picture for a camera near or in the box."""
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
    x, y, z = transform_points(invert_transform(T_object_from_camera), corners).T
    if z.max() <= 0.0:
        return 0, 0, 0, 0
    if z.min() <= 1e-3 * z.max():
        return 0, 0, pinhole.width, pinhole.height
    u, v = pinhole.fx * x / z + pinhole.cx, pinhole.fy * y / z + pinhole.cy
    left, right = np.clip([np.floor(u.min()), np.ceil(u.max())], 0, pinhole.width).astype(int)
    top, bottom = np.clip([np.floor(v.min()), np.ceil(v.max())], 0, pinhole.height).astype(int)
    return int(left), int(top), int(right), int(bottom)


def crossing(origins: Tensor, directions: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Ray parameters ``[R]`` [m] where rays enter and leave a box; a ray that misses it leaves before it enters."""
    inverse = 1.0 / torch.where(directions.abs() < 1e-9, torch.full_like(directions, 1e-9), directions)
    a, b = (low - origins) * inverse, (high - origins) * inverse
    return torch.minimum(a, b).amax(-1).clamp(min=0.0), torch.maximum(a, b).amin(-1)


def _looks_elsewhere() -> FitError:
    return FitError(
        "expected the pictures to look at the object's box, none of them does: are box and poses right?"
    )
