"""Rays of pinhole cameras in box coordinates (see ``march_kernels``), for training pixels and for whole images."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from advnerf_core.geometry import Pinhole
from advnerf_core.parallel import KERNEL_OPTIONS

Array32 = NDArray[np.float32]


def intrinsics_row(pinhole: Pinhole) -> Array32:
    """``fx, fy, cx, cy`` [px] as float32 ``[4]``."""
    return np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy], np.float32)


def poses_in_box(
    T_world_from_camera: ArrayLike, box_low_m: ArrayLike, extent_m: float, ray_unit_m: float = 1.0
) -> Array32:
    """Camera poses for the ray kernels.

    Args:
        T_world_from_camera: ``[B, 4, 4]``.
        box_low_m: Low corner of the box ``[3]`` [m].
        extent_m: Longest side of the box [m].
        ray_unit_m: Unit of ray parameters [m].

    Returns:
        ``[B, 3, 4]`` float32: rotation divided by the extent, so that ray parameters stay in their unit, and position in box units.
    """
    T = np.asarray(T_world_from_camera, np.float64)[..., :3, :] / extent_m
    T[..., 3] -= np.asarray(box_low_m, np.float64) / extent_m
    T[..., :3] *= ray_unit_m
    return np.ascontiguousarray(T, np.float32)


@njit(**KERNEL_OPTIONS)
def write_ray(
    pose: Array32, intrinsics: Array32, column: np.float32, row: np.float32, ray: Array32
) -> np.float32:
    """Write origin and direction ``[6]`` of the ray through a pixel position; returns its planar depth per metre of ray."""
    f = np.float32
    x, y = (column - intrinsics[2]) / intrinsics[0], (row - intrinsics[3]) / intrinsics[1]
    scale = f(1.0) / f(math.sqrt(x * x + y * y + f(1.0)))
    for axis in range(3):
        ray[axis] = pose[axis, 3]
        ray[3 + axis] = (pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2]) * scale
    return scale


@njit(**KERNEL_OPTIONS)
def pixel_rays(
    pixels: NDArray[np.int64],
    images: NDArray[np.uint8],
    poses: Array32,
    intrinsics: Array32,
    rays: Array32,
    colours: NDArray[np.uint8],
) -> None:
    """Rays and colours of single pixels.

    Args:
        pixels: Flat indices ``[R]`` into ``[N, H, W]``.
        images: ``[N, H, W, 3]``.
        poses: ``[N, 3, 4]`` from ``poses_in_box``.
        intrinsics: ``[N, 4]``.
        rays: ``[R, 6]``, written.
        colours: ``[R, 3]``, written.
    """
    height, width = images.shape[1], images.shape[2]
    half = np.float32(0.5)
    for r in range(pixels.shape[0]):
        image, rest = pixels[r] // (height * width), pixels[r] % (height * width)
        row, column = rest // width, rest % width
        write_ray(poses[image], intrinsics[image], np.float32(column) + half, np.float32(row) + half, rays[r])
        for c in range(3):
            colours[r, c] = images[image, row, column, c]
