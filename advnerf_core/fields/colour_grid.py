"""The grid of an object's free colours: the cell that each row of its theta stands for.

The colours of a face and of a textured mesh are a picture; a voxel object's fill its box. Random textures with
spatial structure are defined on these grids.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from advnerf_core.errors import AdvnerfError
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.fields.voxel_grid import VoxelGridObject


class ColourGridError(AdvnerfError, ValueError):
    """The parameters of an object have no grid."""


@dataclass(frozen=True, eq=False)
class ColourGrid:
    """A grid of two or three dimensions, and the cells of it that are free.

    Attributes:
        shape: Cells along each edge: rows and columns of a texture, or the edges of a box.
        cells: Cell of each row of theta, ``[rows, d]`` int64.
    """

    shape: tuple[int, ...]
    cells: Tensor

    @property
    def places(self) -> Tensor:
        """Centres of the cells in 0..1 along each edge, ``[rows, d]``."""
        return (self.cells + 0.5) / torch.tensor(self.shape)


def colour_grid(field: ColouredObject) -> ColourGrid:
    """The grid of an object's colours.

    Raises:
        ColourGridError: The object's parameters are not colours of cells, such as summed levels.
    """
    if field.mixing is None and len(field.theta_shape) > 2:
        shape = tuple(field.theta_shape[:-1])
        return ColourGrid(shape, torch.from_numpy(np.argwhere(np.ones(shape, dtype=bool))))
    if field.mixing is None and isinstance(field, VoxelGridObject):
        return ColourGrid(field.slots.shape, _first_voxels(field))
    raise ColourGridError(
        f"expected an object with one colour for each cell of a grid, got theta of shape {tuple(field.theta_shape)}, which is summed or on "
        "no grid; use the method random, or an object without summed levels"
    )


def _first_voxels(field: VoxelGridObject) -> Tensor:
    """The first voxel that shows each free row, ``[rows, 3]``; a row without voxels gets the first of all."""
    rows = field.slots.reshape(-1)
    voxels = np.flatnonzero(rows < field.free_count)[::-1]
    first = np.zeros(field.free_count, dtype=np.int64)
    first[rows[voxels]] = voxels  # of several assignments the last remains
    return torch.from_numpy(np.stack(np.unravel_index(first, field.slots.shape), axis=1))
