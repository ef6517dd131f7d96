"""Casting of voxel-grid objects to sparse per-pixel linear weights.

With frozen geometry the premultiplied colour of a pixel is ``sum_k w_k c_k`` over rows of the object's squashed colour vector
``c`` (``VoxelGridObject.colours``). One cast finds the pixels an object covers, their alpha and planar depth, and the weights
as a sparse matrix ``W [pixels, slots]``: the render is ``W c`` and its vector-Jacobian product is ``W^T g``. Nothing here is
differentiable with respect to poses, density or camera.

Several rays a pixel (``supersample``) are averaged over the pixel's area, which is what an area filter does to a finer image.
Depth is planar z in the camera frame: rays are marched with directions of unit planar depth, so the ray parameter is z in
metres, and extinction is integrated over length in object units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import Array, Pinhole, invert_transform, transform_points

NEAR_M = 0.02  # closer than this to the camera nothing is drawn
_STOP_TRANSMITTANCE = 1e-6


@dataclass(frozen=True, eq=False)
class ObjectCast:
    """What one object contributes to a batch of images.

    Attributes:
        pixels: Flat indices into ``[B, H, W]`` of the pixels that the object covers at least in part, ``[P]`` int64, ascending.
        alpha: Coverage times opacity, ``[P]`` in 0..1.
        depth_m: Planar depth, averaged with the rendering weights, ``[P]`` [m].
        weights: Rendering weights ``[P, slots]``, CSR; each row sums to alpha.
    """

    pixels: NDArray[np.int64]
    alpha: Array
    depth_m: Array
    weights: sparse.csr_matrix

    @property
    def nbytes(self) -> int:
        """Memory held by the arrays [bytes]."""
        w = self.weights
        parts = (self.pixels, self.alpha, self.depth_m, w.data, w.indices, w.indptr)
        return int(sum(part.nbytes for part in parts))


def cast_object(
    field: VoxelGridObject,
    T_world_from_camera: ArrayLike,
    pinhole: Pinhole,
    supersample: int = 2,
    dtype: Any = np.float32,
) -> ObjectCast:
    """Cast an object into a batch of cameras.

    Args:
        field: The object.
        T_world_from_camera: Camera poses ``[B, 4, 4]``, OpenCV axes.
        pinhole: Intrinsics of all of them.
        supersample: Rays along each side of a pixel.
        dtype: Type of the weights, float32 or float64; geometry is always float64.
    """
    poses = np.asarray(T_world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
    if supersample < 1:
        raise ValueError(f"expected at least 1 ray along a pixel's side, got {supersample}")
    T_object_from_camera = invert_transform(field.T_world_from_object) @ poses
    parts = [
        _cast_one(field, T, window, pinhole, supersample)
        for T, window in zip(T_object_from_camera, _windows(field, poses, pinhole), strict=True)
    ]
    image_size = pinhole.width * pinhole.height
    pixels = np.concatenate([part.pixels + b * image_size for b, part in enumerate(parts)])
    weights = sparse.vstack([part.weights for part in parts], format="csr", dtype=dtype)
    alpha, depth_m = (np.concatenate([getattr(part, name) for part in parts]) for name in ("alpha", "depth_m"))
    return ObjectCast(pixels, alpha, depth_m, weights)


def _cast_one(
    field: VoxelGridObject, T_object_from_camera: Array, window: NDArray[np.int64], pinhole: Pinhole, supersample: int
) -> ObjectCast:
    """Cast into one image; pixels are flat indices into ``[H, W]``, weights float64."""
    solid = field.density is None
    density = np.zeros((1, 1, 1)) if field.density is None else np.ascontiguousarray(field.density, dtype=np.float64)
    area = int(max(0, window[1] - window[0]) * max(0, window[3] - window[2]))
    pixels, alpha, depth_m = np.empty(area, np.int64), np.empty(area), np.empty(area)
    starts = np.zeros(area + 1, np.int64)
    room = area * 4 * supersample + 64
    while True:
        indices, values = np.empty(room, np.int64), np.empty(room)
        found = _cast_window(
            np.ascontiguousarray(T_object_from_camera[:3, :3]) / field.scale, T_object_from_camera[:3, 3] / field.scale,
            window, np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy]), pinhole.width, supersample,
            np.ascontiguousarray(field.slots), density, solid, field.one_sided,
            np.asarray(field.box_min, dtype=np.float64), np.asarray(field.box_max, dtype=np.float64), field.step_units,
            np.zeros(field.slot_count), np.empty(field.slot_count, np.int64), np.empty((8, 3), np.int64), np.empty(8),
            np.empty(6), pixels, alpha, depth_m, starts, indices, values,
        )  # fmt: skip
        if found >= 0:
            break
        room *= 4
    filled = int(starts[found])
    shape = (found, field.slot_count)
    weights = sparse.csr_matrix((values[:filled].copy(), indices[:filled].astype(np.int32), starts[: found + 1]), shape)
    return ObjectCast(pixels[:found].copy(), alpha[:found].copy(), depth_m[:found].copy(), weights)


def _windows(field: VoxelGridObject, poses: Array, pinhole: Pinhole) -> NDArray[np.int64]:
    """Pixel windows ``[B, 4]`` (first row, end row, first column, end column) that surely hold the object."""
    corners = transform_corners(poses, field.corners_in_world())
    windows = np.zeros((len(poses), 4), dtype=np.int64)
    windows[:, 1], windows[:, 3] = pinhole.height, pinhole.width
    ahead = (corners[..., 2] > NEAR_M).all(axis=1)
    uv = pinhole.project(corners[ahead])
    low, high = np.floor(uv.min(axis=1)).astype(np.int64) - 1, np.ceil(uv.max(axis=1)).astype(np.int64) + 1
    windows[ahead, 0] = np.clip(low[:, 1], 0, pinhole.height)
    windows[ahead, 1] = np.clip(high[:, 1], 0, pinhole.height)
    windows[ahead, 2] = np.clip(low[:, 0], 0, pinhole.width)
    windows[ahead, 3] = np.clip(high[:, 0], 0, pinhole.width)
    windows[(corners[..., 2] <= NEAR_M).all(axis=1)] = 0
    return windows


def transform_corners(T_world_from_camera: Array, points_in_world: Array) -> Array:
    """Points ``[N, 3]`` of the world in each of ``[B]`` cameras, ``[B, N, 3]``."""
    return np.stack([transform_points(T, points_in_world) for T in invert_transform(T_world_from_camera)])


@njit(cache=True, error_model="numpy")
def _enter_box(o: Any, d: Any, low: Any, high: Any, near: float) -> tuple[float, float, bool]:
    """Ray parameters of entry and exit, and whether the entry is through the face at ``high[0]``; exit <= entry is a miss."""
    t_in, t_out, by_face = near, np.inf, False
    for axis in range(3):
        if abs(d[axis]) < 1e-15:
            if o[axis] < low[axis] or o[axis] > high[axis]:
                return 1.0, 0.0, False
            continue
        t_low, t_high = (low[axis] - o[axis]) / d[axis], (high[axis] - o[axis]) / d[axis]
        first, last = min(t_low, t_high), max(t_low, t_high)
        if first > t_in:
            t_in = first
            by_face = axis == 0 and d[0] < 0.0
        t_out = min(t_out, last)
    return t_in, t_out, by_face


@njit(cache=True, error_model="numpy")
def _corner(position: float, low: float, high: float, count: int) -> tuple[int, int, float]:
    """Neighbouring voxels along one axis and the weight of the second; clamped beyond the outer voxel centres."""
    g = (position - low) / (high - low) * count - 0.5
    g = min(max(g, 0.0), count - 1.0)
    first = min(int(g), max(count - 2, 0))
    return first, min(first + 1, count - 1), g - first


@njit(cache=True, error_model="numpy")
def _gather(p: Any, low: Any, high: Any, slots: Any, cells: Any, shares: Any) -> None:
    """The eight voxels around ``p`` and their trilinear shares, written to ``cells [8, 3]`` and ``shares [8]``."""
    x0, x1, fx = _corner(p[0], low[0], high[0], slots.shape[0])
    y0, y1, fy = _corner(p[1], low[1], high[1], slots.shape[1])
    z0, z1, fz = _corner(p[2], low[2], high[2], slots.shape[2])
    for k in range(8):
        a, b, c = k & 1, (k >> 1) & 1, k >> 2
        cells[k, 0] = x1 if a else x0
        cells[k, 1] = y1 if b else y0
        cells[k, 2] = z1 if c else z0
        shares[k] = (fx if a else 1.0 - fx) * (fy if b else 1.0 - fy) * (fz if c else 1.0 - fz)


@njit(cache=True, error_model="numpy")
def _march(o: Any, d: Any, p: Any, t_in: float, t_out: float, slots: Any, density: Any, solid: bool, low: Any, high: Any,
           step: float, share: float, row: Any, touched: Any, count: int, cells: Any,
           shares: Any) -> tuple[int, float, float]:  # fmt: skip
    """Add one ray to the dense scratch ``row [slots]``; returns the touched count, the ray's alpha and alpha-weighted depth."""
    speed = np.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)  # object units a metre of planar depth
    samples = 1 if solid else max(1, int(np.ceil((t_out - t_in) * speed / step)))
    dt = (t_out - t_in) / samples
    transmittance, alpha, alpha_depth = 1.0, 0.0, 0.0
    for i in range(samples):
        t = t_in if solid else t_in + (i + 0.5) * dt
        for axis in range(3):
            p[axis] = o[axis] + t * d[axis]
        _gather(p, low, high, slots, cells, shares)
        opacity = 1.0
        if not solid:
            sigma = 0.0
            for k in range(8):
                sigma += shares[k] * density[cells[k, 0], cells[k, 1], cells[k, 2]]
            opacity = 1.0 - np.exp(-sigma * dt * speed)
        weight = transmittance * opacity * share
        if weight > 0.0:
            alpha += weight
            alpha_depth += weight * t
            for k in range(8):
                if shares[k] > 0.0:
                    slot = slots[cells[k, 0], cells[k, 1], cells[k, 2]]
                    if row[slot] == 0.0:
                        touched[count] = slot
                        count += 1
                    row[slot] += weight * shares[k]
        transmittance *= 1.0 - opacity
        if transmittance < _STOP_TRANSMITTANCE:
            break
    return count, alpha, alpha_depth


@njit(cache=True, error_model="numpy")
def _cast_window(R: Any, o: Any, window: Any, intrinsics: Any, width: int, supersample: int, slots: Any, density: Any,
                 solid: bool, one_sided: bool, low: Any, high: Any, step: float, row: Any, touched: Any, cells: Any,
                 shares: Any, scratch: Any, pixels: Any, alphas: Any, depths: Any, starts: Any, indices: Any,
                 values: Any) -> int:  # fmt: skip
    """All rays of one window; arrays are the caller's, as compiling array making costs seconds.

    Returns the number of covered pixels, or -1 if ``indices`` and ``values`` are too short.
    """
    d, p = scratch[:3], scratch[3:]
    share, found, filled = 1.0 / (supersample * supersample), 0, 0
    for v in range(window[0], window[1]):
        for u in range(window[2], window[3]):
            alpha, alpha_depth, count = 0.0, 0.0, 0
            for s in range(supersample * supersample):
                x = (u + (s % supersample + 0.5) / supersample - intrinsics[2]) / intrinsics[0]
                y = (v + (s // supersample + 0.5) / supersample - intrinsics[3]) / intrinsics[1]
                for axis in range(3):
                    d[axis] = R[axis, 0] * x + R[axis, 1] * y + R[axis, 2]
                t_in, t_out, by_face = _enter_box(o, d, low, high, NEAR_M)
                if t_out <= t_in or (one_sided and not by_face):
                    continue
                count, a, ad = _march(
                    o,
                    d,
                    p,
                    t_in,
                    t_out,
                    slots,
                    density,
                    solid,
                    low,
                    high,
                    step,
                    share,
                    row,
                    touched,
                    count,
                    cells,
                    shares,
                )
                alpha += a
                alpha_depth += ad
            if alpha <= 0.0:
                continue
            if filled + count > len(indices):
                return -1
            for k in range(count):
                indices[filled + k] = touched[k]
                values[filled + k] = row[touched[k]]
                row[touched[k]] = 0.0
            filled += count
            pixels[found] = v * width + u
            alphas[found] = alpha
            depths[found] = alpha_depth / alpha
            found += 1
            starts[found] = filled
    return found
