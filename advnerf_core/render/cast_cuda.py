"""Voxel-grid objects in the memory of a GPU, drawn into images and differentiated there by numba-cuda's kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.errors import DeviceError
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.geometry import Array, Pinhole
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
from advnerf_core.render.cast_object import prepared
from advnerf_core.render.cast_torch import object_places, sum_of_slopes, voxel_edges, voxel_objects
from advnerf_core.render.cuda_launch import launch


class CudaObjects:
    """Objects at fixed places.

    Args:
        objects: At least one, at most `MOST_OBJECTS`, all voxel grids.
        pinhole: Camera of all images.
        supersample: Rays along each side of a pixel.
        dtype: Type of densities and images; geometry is float64 in any case.
        tolerance_m: Distance behind the background at which an object is still visible [m].

    Raises:
        DeviceError: An object is not a voxel grid, or there are too many.
    """

    def __init__(
        self,
        objects: Sequence[ColouredObject],
        pinhole: Pinhole,
        supersample: int,
        dtype: torch.dtype,
        tolerance_m: float,
        device: torch.device,
    ) -> None:
        self.objects, self.device, self.dtype = voxel_objects(objects), device, dtype
        if len(objects) > MOST_OBJECTS:
            raise DeviceError(f"expected at most {MOST_OBJECTS} objects on a GPU, got {len(objects)}")
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
            edges[EDGES : EDGES + 3] = voxel_edges(field)
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
        frames, seen = object_places(self.objects, T_world_from_camera, self._pinhole)
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

        def pull(slopes: Tensor, scale: Tensor) -> Tensor:
            total = torch.zeros(colours.shape, dtype=torch.int64, device=self.device)
            launch(pull_objects, slopes.numel() // 3, *places, self._intrinsics, self._supersample, *self._grids, colours, texture_of, shares,
                   slopes, scale, total)  # fmt: skip
            return total

        return sum_of_slopes(slopes, pull)

    def _there(self, array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.device)
