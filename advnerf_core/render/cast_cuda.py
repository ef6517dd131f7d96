"""Voxel-grid objects in the memory of a GPU, drawn into images and differentiated there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.errors import DeviceError
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import Array, Pinhole, invert_transform
from advnerf_core.render.cast_cuda_kernels import (
    EDGES,
    FIRST_CELL,
    FIRST_COLOUR,
    FIRST_VOXEL,
    FREE,
    LENGTHS,
    MOST_OBJECTS,
    ONE_SIDED,
    SOLID,
    STEP,
    VOXELS,
    WHOLE_NUMBERS,
    draw_objects,
    pull_objects,
)
from advnerf_core.render.cast_object import prepared, windows
from advnerf_core.render.cuda_launch import cuda_device, launch

# 64-bit whole numbers hold the sum of all pixels' slopes with a bit to spare.
_SUM_BITS = 62


def check_drawable(objects: Sequence[ColouredObject]) -> list[VoxelGridObject]:
    """The objects, if a GPU can draw all of them.

    Raises:
        DeviceError: An object is not a voxel grid, or there are too many.
    """
    grids = [field for field in objects if isinstance(field, VoxelGridObject)]
    if len(grids) != len(objects):
        other = next(type(field).__name__ for field in objects if not isinstance(field, VoxelGridObject))
        raise DeviceError(f"expected objects made of voxels on a GPU, got a {other}; search on the processor")
    if len(grids) > MOST_OBJECTS:
        raise DeviceError(f"expected at most {MOST_OBJECTS} objects on a GPU, got {len(grids)}")
    return grids


class CudaObjects:
    """Objects at fixed places.

    Args:
        objects: At least one, at most `MOST_OBJECTS`, all voxel grids.
        pinhole: Camera of all images.
        supersample: Rays along each side of a pixel.
        dtype: Type of densities and images; geometry is float64 in any case.
        tolerance_m: Distance behind the background at which an object is still visible [m].

    Raises:
        DeviceError: No device is available; and see `check_drawable`.
    """

    def __init__(
        self,
        objects: Sequence[ColouredObject],
        pinhole: Pinhole,
        supersample: int,
        dtype: torch.dtype,
        tolerance_m: float,
    ) -> None:
        self.objects, self.device, self.dtype = check_drawable(objects), cuda_device(), dtype
        self._pinhole, self._supersample = pinhole, supersample
        self._tolerance_m = tolerance_m
        grids = [prepared(field, torch.empty(0, dtype=dtype).numpy().dtype) for field in self.objects]
        whole = np.zeros((len(grids), WHOLE_NUMBERS), np.int64)
        lengths = np.zeros((len(grids), LENGTHS))
        voxels = cells = colours = 0
        densities: list[NDArray[Any]] = []
        for row, edges, field, grid in zip(whole, lengths, self.objects, grids, strict=True):
            solid = field.density is None
            row[VOXELS : VOXELS + 3] = grid.slots.shape
            row[[FIRST_VOXEL, FIRST_CELL, FIRST_COLOUR]] = voxels, cells, colours
            row[[FREE, SOLID, ONE_SIDED]] = field.free_count, solid, field.one_sided
            edges[EDGES : EDGES + 3] = _edges(field)
            edges[STEP] = field.step_units
            # One index serves for a voxel's colour and its density.
            densities.append(
                np.zeros(grid.slots.size, grid.density.dtype) if solid else grid.density.reshape(-1)
            )
            voxels, cells, colours = (
                voxels + grid.slots.size,
                cells + grid.clear.size,
                colours + field.slot_count,
            )
        self._grids = tuple(
            self._there(each)
            for each in (
                whole,
                lengths,
                np.concatenate([grid.slots.reshape(-1) for grid in grids]),
                np.concatenate(densities),
                np.concatenate([grid.clear.reshape(-1) for grid in grids]),
            )
        )
        self._intrinsics = self._there(np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy]))

    def placed(self, T_world_from_camera: Array) -> tuple[Tensor, Tensor]:
        """Places of the objects for cameras ``[B, 4, 4]``: ``frames`` and ``windows`` of `draw_objects`."""
        T_camera_from_world = invert_transform(T_world_from_camera)
        frames = np.empty((len(self.objects), len(T_world_from_camera), 12))
        seen = np.empty((*frames.shape[:2], 4), np.int32)
        for k, field in enumerate(self.objects):
            edges = _edges(field)
            T = invert_transform(field.T_world_from_object) @ T_world_from_camera
            frames[k, :, :9] = (T[:, :3, :3] / field.scale / edges[:, None]).reshape(-1, 9)
            frames[k, :, 9:] = (T[:, :3, 3] / field.scale - field.box_min) / edges - 0.5
            seen[k] = windows(field, T_camera_from_world, self._pinhole)
        return self._there(frames), self._there(seen)

    def draw(
        self,
        places: tuple[Tensor, Tensor],
        colours: Tensor,
        texture_of: Tensor,
        behind_m: Tensor,
        image: Tensor,
    ) -> Tensor:
        """Draw into ``image [B, 3, H, W]``, a background of planar depth ``behind_m [B, H, W]``; returns the ``shares`` of `draw_objects`.

        Args:
            places: From `placed`.
            colours: All objects' colour vectors in their order, for each texture ``[N, V, 3]``.
            texture_of: Index of each image's texture ``[B]`` int32.
            behind_m: Planar depth of the background ``[B, H, W]`` [m].
            image: Background, which is drawn into.
        """
        shares = torch.empty((len(self.objects), *behind_m.shape), dtype=self.dtype, device=self.device)
        nothing = torch.zeros((0, 3), dtype=torch.int64, device=self.device)
        launch(draw_objects, behind_m.numel(), *places, self._intrinsics, self._supersample, *self._grids, colours, texture_of, behind_m,
               self._tolerance_m, image, shares, nothing)  # fmt: skip
        return shares

    def pull(
        self,
        places: tuple[Tensor, Tensor],
        colours: Tensor,
        texture_of: Tensor,
        shares: Tensor,
        slopes: Tensor,
    ) -> Tensor:
        """Gradient with respect to ``colours [N, V, 3]`` from one with respect to the images ``[B, 3, H, W]``; the same bits every time."""
        largest = slopes.abs().max().double()
        slopes = slopes.nan_to_num(0.0, 0.0, 0.0).contiguous()  # NaN is restored at the end
        pixels = slopes.numel() // 3
        # No sum over all pixels reaches the largest whole number, as a pixel's weights sum to at most one.
        scale = (2.0 ** (_SUM_BITS - pixels.bit_length()) / largest.clamp(1e-200, 1e200)).reshape(1)
        total = torch.zeros(colours.shape, dtype=torch.int64, device=self.device)
        launch(pull_objects, pixels, *places, self._intrinsics, self._supersample, *self._grids, colours, texture_of, shares, slopes, scale,
               total)  # fmt: skip
        return torch.where(torch.isfinite(largest), total.double() / scale, torch.nan).to(colours.dtype)

    def _there(self, array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.device)


def _edges(field: VoxelGridObject) -> Array:
    """Object units per voxel along each axis ``[3]``."""
    edges: Array = (np.asarray(field.box_max, np.float64) - field.box_min) / field.slots.shape
    return edges
