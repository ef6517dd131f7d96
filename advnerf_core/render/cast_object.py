"""Casting of voxel-grid objects to sparse per-pixel linear weights.

With frozen geometry the premultiplied colour of a pixel is ``sum_k w_k c_k`` over rows of the object's squashed colour vector
``c`` (``VoxelGridObject.colours``). One cast finds the pixels an object covers, their alpha and planar depth, and the weights
as a sparse matrix ``W [pixels, slots]``: the render is ``W c`` and its vector-Jacobian product is ``W^T g``. Nothing here is
differentiable with respect to poses, density or camera; ``render/soft_pose`` is, with respect to poses.

Several rays a pixel (``supersample``) are averaged over the pixel's area, like an area filter on a finer image.
Depth is planar z in the camera frame: rays are marched with directions of unit planar depth, so the ray parameter is z in
metres, and extinction is integrated over length in object units.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse

from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.fields.sparse_rows import SparseRows
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import Array, Pinhole, invert_transform
from advnerf_core.parallel import Work, scratch
from advnerf_core.render.cast_kernels import FILLED, FOUND, box_windows, cast_window, reach_of_bricks
from advnerf_core.render.occupancy import leap_distances

# Parts of the work when few images are cast: enough that two to four threads have something to do.
_LEAST_PARTS = 4
_BRICK_CELLS = 4


@dataclass(frozen=True, eq=False)
class ObjectCast:
    """Contribution of one object to a batch of images.

    Attributes:
        pixels: Flat indices into ``[B, H, W]`` of the pixels that the object covers at least in part, ``[P]`` int64, ascending.
        alpha: Coverage times opacity, ``[P]`` in 0..1.
        depth_m: Planar depth, averaged with the rendering weights, ``[P]`` [m].
        rows: Rendering weights ``[P, slots]``; each row sums to alpha.
    """

    pixels: NDArray[np.int64]
    alpha: Array
    depth_m: Array
    rows: SparseRows

    @property
    def weights(self) -> sparse.csr_matrix:
        """The rendering weights as a matrix of SciPy."""
        return self.rows.csr()

    @property
    def nbytes(self) -> int:
        """Memory held by the arrays [bytes]."""
        return self.pixels.nbytes + self.alpha.nbytes + self.depth_m.nbytes + self.rows.nbytes


@runtime_checkable
class CastsItself(Protocol):
    """An object with its own casting, other than a voxel grid."""

    def cast(self, T_world_from_camera: Array, pinhole: Pinhole, supersample: int, dtype: Any) -> ObjectCast:
        """Cast into cameras ``[B, 4, 4]``; see :func:`cast_work`."""


def cast_object(
    field: ColouredObject,
    T_world_from_camera: ArrayLike,
    pinhole: Pinhole,
    supersample: int = 2,
    dtype: Any = np.float32,
) -> ObjectCast:
    """Cast an object into a batch of cameras; see :func:`cast_work`."""
    return cast_work([field], T_world_from_camera, pinhole, supersample, dtype).run()[0]


def cast_work(
    fields: Sequence[ColouredObject],
    T_world_from_camera: ArrayLike,
    pinhole: Pinhole,
    supersample: int = 2,
    dtype: Any = np.float32,
) -> Work[list[ObjectCast]]:
    """The casting of objects into a batch of cameras, not begun yet; each pixel's result does not depend on the others.

    Args:
        T_world_from_camera: Camera poses ``[B, 4, 4]``, OpenCV axes; one that is not finite sees nothing.
        supersample: Rays along each side of a pixel.
        dtype: Type of the weights, float32 or float64; geometry is always float64.

    Raises:
        ValueError: No rays.
    """
    poses = np.asarray(T_world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
    if supersample < 1:
        raise ValueError(f"expected at least 1 ray along a pixel's side, got {supersample}")
    grids = {k: field for k, field in enumerate(fields) if isinstance(field, VoxelGridObject)}
    jobs = _grid_parts(grids, poses, pinhole, supersample, dtype)

    def result() -> list[ObjectCast]:
        casts = {
            k: _joined([part for owner, part in jobs if owner == k], field, dtype)
            for k, field in grids.items()
        }
        for k, field in enumerate(fields):
            if k not in grids and isinstance(field, CastsItself):
                casts[k] = field.cast(poses, pinhole, supersample, dtype)
        return [casts[k] for k in range(len(fields))]

    # The longest first: threads end together.
    parts = sorted((part for _, part in jobs), key=lambda part: -part.area)
    return Work([part.cast for part in parts], result)


def _grid_parts(
    fields: Mapping[int, VoxelGridObject], poses: Array, pinhole: Pinhole, supersample: int, dtype: Any
) -> list[tuple[int, _ObjectCast]]:
    bands = max(1, -(-_LEAST_PARTS // max(1, len(poses) * len(fields))))
    T_camera_from_world = invert_transform(poses)
    parts = []
    for k, field in fields.items():
        views = _views(prepared(field, dtype), field, poses)
        for b, whole in enumerate(windows(field, T_camera_from_world, pinhole)):
            if whole[0] < whole[1] and whole[2] < whole[3]:
                offset = b * pinhole.width * pinhole.height
                parts += [
                    (k, _ObjectCast(field, views[b], pinhole, supersample, window, offset))
                    for window in _bands(whole, bands)
                ]
    return parts


@dataclass(frozen=True, eq=False)
class _View:
    """A camera in an object's voxel coordinates, and the object in the form of the kernel.

    ``R [3, 3]`` takes camera axes [m] to voxels, ``o [3]`` is the camera's place, and ``edges [3]`` are the voxels' sides in object units.
    """

    grids: KernelGrids
    R: Array
    R_inverse: Array
    o: Array
    edges: Array


def _views(grids: KernelGrids, field: VoxelGridObject, T_world_from_camera: Array) -> list[_View]:
    """The cameras ``[B, 4, 4]`` in voxel coordinates."""
    edges = (np.asarray(field.box_max, np.float64) - field.box_min) / grids.slots.shape
    T = invert_transform(field.T_world_from_object) @ T_world_from_camera
    R = T[:, :3, :3] / field.scale / edges[:, None]
    o = (T[:, :3, 3] / field.scale - field.box_min) / edges - 0.5
    # The rotation's inverse is its transpose, also of a pose that is not finite.
    R_inverse = T[:, :3, :3].swapaxes(1, 2) * field.scale * edges
    return [_View(grids, *each, edges) for each in zip(R, np.ascontiguousarray(R_inverse), o, strict=True)]


def made_opaque(cast: ObjectCast) -> ObjectCast:
    """The cast with each pixel either wholly covered or not at all; half covered counts as covered."""
    kept = np.flatnonzero(cast.alpha >= 0.5)
    rows = cast.rows.take(kept)
    values = rows.values
    values /= np.repeat(cast.alpha[kept], np.diff(rows.ends)).astype(values.dtype)
    return ObjectCast(cast.pixels[kept], np.ones(len(kept)), cast.depth_m[kept], rows)


@dataclass(frozen=True, eq=False)
class KernelGrids:
    """An object in the form of the kernel.

    ``low`` and ``high`` bound the non-empty part, in object units; ``bricks [N, 2, 3]`` are boxes in voxel coordinates that contain it.
    """

    slots: NDArray[np.int32]
    density: NDArray[Any]
    clear: NDArray[np.uint8]
    bricks: Array
    low: Array
    high: Array


def prepared(field: VoxelGridObject, dtype: Any) -> KernelGrids:
    """Grids in the kernel's types; made once per object and type, and shared by its moved copies."""
    key = ("cast", np.dtype(dtype).char)
    if key not in field.derived:
        slots = np.require(field.slots, np.int32, ["C", "W"])
        low, high = np.asarray(field.box_min, np.float64), np.asarray(field.box_max, np.float64)
        if field.density is None:
            field.derived[key] = KernelGrids(
                slots,
                np.zeros((1, 1, 1), dtype),
                np.zeros((1, 1, 1), np.uint8),
                _whole(slots.shape),
                low,
                high,
            )
        else:
            density = np.require(field.density, dtype, ["C", "W"])
            filled = cells_with_density(density)
            edge = (high - low) / slots.shape
            corners = np.argwhere(filled)
            if len(corners):
                # A cell reaches from one voxel centre to the next, and to the border of the box at its ends.
                first, last = corners.min(axis=0), corners.max(axis=0) + 1
                low, high = (
                    np.where(first == 0, low, low + edge * (first + 0.5)),
                    np.where(last >= np.array(slots.shape) - 1, high, low + edge * (last + 0.5)),
                )
            field.derived[key] = KernelGrids(
                slots,
                density,
                leap_distances(filled, np.ones(3, np.float32)).distance,
                bricks_of(filled, slots.shape),
                low,
                high,
            )
    grids: KernelGrids = field.derived[key]
    return grids


def cells_with_density(density: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether cells between voxel centres have density at a corner, ``[max(nx - 1, 1), ...]``."""
    near = ndimage.maximum_filter(
        density > 0, size=[min(n, 2) for n in density.shape], origin=[-(n > 1) for n in density.shape]
    )
    return np.ascontiguousarray(near[tuple(slice(0, max(n - 1, 1)) for n in density.shape)])


def bricks_of(filled: NDArray[np.bool_], voxels: tuple[int, ...]) -> Array:
    """Boxes ``[N, 2, 3]`` in voxel coordinates that contain all ``filled`` cells, a few cells along each side."""
    corners = np.argwhere(filled)
    bricks = [-(-cells // _BRICK_CELLS) for cells in filled.shape]
    # Of numbers, as rows of three are sorted many times slower.
    numbers = np.ravel_multi_index(tuple((corners // _BRICK_CELLS).T), bricks)
    brick = np.unique(numbers, return_inverse=True)[1]
    count = int(brick.max()) + 1 if len(brick) else 0
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, brick, corners)
    np.maximum.at(high, brick, corners + 1)
    # The first and the last cells reach to the border of the box.
    last = np.array(voxels) - 1
    return np.stack([np.where(low == 0, -0.5, low), np.where(high >= last, last + 0.5, high)], axis=1)


def _whole(voxels: tuple[int, ...]) -> Array:
    return np.array([[np.full(3, -0.5), np.array(voxels) - 0.5]])


class _ObjectCast:
    """The cast of one object into rows of one image."""

    def __init__(
        self,
        field: VoxelGridObject,
        view: _View,
        pinhole: Pinhole,
        supersample: int,
        window: NDArray[np.int64],
        offset: int,
    ) -> None:
        self._field, self._view, self._pinhole = field, view, pinhole
        self._supersample, self._window, self._offset = supersample, window, offset

    @property
    def area(self) -> int:
        """Pixels of the window."""
        return int(max(0, self._window[1] - self._window[0]) * max(0, self._window[3] - self._window[2]))

    def cast(self) -> None:
        """Fill ``pixels`` (of the batch), ``alpha``, ``depth_m``, ``ends``, ``indices`` and ``values``."""
        field, view, window, lens = self._field, self._view, self._window, self._pinhole
        grids, area, slots = view.grids, self.area, self._field.slot_count
        pixels, alpha, depth_m, ends = (
            np.empty(area, np.int64),
            np.empty(area),
            np.empty(area),
            np.empty(area, np.int64),
        )
        room = area * 16 * self._supersample + 64  # unused memory is never touched
        indices, values = np.empty(room, np.int32), np.empty(room, grids.density.dtype)
        # The kernel leaves the row as zeros.
        shape = max(0, window[1] - window[0]), max(0, window[3] - window[2])
        nearest_m, furthest_m = np.full(shape, np.inf), np.full(shape, -np.inf)
        intrinsics = np.array([lens.fx, lens.fy, lens.cx, lens.cy])
        reach_of_bricks(view.R_inverse, view.o, grids.bricks, window, intrinsics, nearest_m, furthest_m)
        row = scratch("row", slots, grids.density.dtype)
        touched = scratch("touched", slots + 1, np.int32)
        progress = np.zeros(3, np.int64)
        while not cast_window(
            view.R,
            view.o,
            view.edges,
            window,
            intrinsics,
            nearest_m,
            furthest_m,
            lens.width,
            self._supersample,
            grids.slots,
            grids.density,
            grids.clear,
            field.density is None,
            field.one_sided,
            float(field.step_units),
            row,
            touched,
            progress,
            pixels,
            alpha,
            depth_m,
            ends,
            indices,
            values,
        ):
            indices, values = (
                np.concatenate([part, np.empty(3 * len(part), part.dtype)]) for part in (indices, values)
            )
        found, filled = int(progress[FOUND]), int(progress[FILLED])
        self.pixels, self.alpha, self.depth_m = pixels[:found] + self._offset, alpha[:found], depth_m[:found]
        self.ends, self.indices, self.values = ends[:found], indices[:filled], values[:filled]


def _joined(parts: Sequence[_ObjectCast], field: VoxelGridObject, dtype: Any) -> ObjectCast:
    """One cast of all images from their parts in order."""
    before = np.concatenate([[0], np.cumsum([len(part.values) for part in parts])])
    starts = [np.zeros(1, np.int64), *(part.ends + first for part, first in zip(parts, before, strict=False))]
    pixels, alpha, depth_m, values, indices = (
        np.concatenate([getattr(part, name) for part in parts] or [np.zeros(0, kind)])
        for name, kind in (
            ("pixels", np.int64),
            ("alpha", np.float64),
            ("depth_m", np.float64),
            ("values", dtype),
            ("indices", np.int32),
        )
    )
    rows = SparseRows(np.concatenate(starts).astype(np.int32), indices, values, field.slot_count)
    return ObjectCast(pixels, alpha, depth_m, rows)


def _bands(window: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """A window cut into ``count`` bands of rows."""
    if count == 1:
        return [window]
    edges = np.linspace(window[0], max(window[1], window[0]), count + 1).astype(np.int64)
    return [np.array([first, last, window[2], window[3]]) for first, last in itertools.pairwise(edges)]


def windows(field: VoxelGridObject, T_camera_from_world: Array, pinhole: Pinhole) -> NDArray[np.int64]:
    """Pixel ranges ``[B, 4]`` (first row, end row, first column, end column) that surely contain the object."""
    grids = prepared(field, np.float32)
    T_camera_from_object = np.ascontiguousarray(T_camera_from_world @ field.T_world_from_object)
    intrinsics = np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy])
    box = field.scale * np.stack([grids.low, grids.high])
    return box_windows(T_camera_from_object, box, intrinsics, pinhole.width, pinhole.height)
