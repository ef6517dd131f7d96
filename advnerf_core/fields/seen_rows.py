"""The visible rows of an object's colour vector in a batch of images, which a render and its gradient are limited to.

A 64^3 object has a quarter of a million voxels, but a frame shows a few thousand. Squashing, mixing and their derivatives
are taken for these only.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.fields.sparse_rows import SparseRows
from advnerf_core.fields.voxel_grid import squash, squash_derivative
from advnerf_core.parallel import KERNEL_OPTIONS, scratch


class SeenRows:
    """Rows of an object's colour vector.

    Args:
        rows: Indices of the rows, ascending, ``[V]`` int64.
    """

    def __init__(self, field: ColouredObject, rows: NDArray[np.int64]) -> None:
        self.field, self.rows = field, rows
        free = rows[: int(np.searchsorted(rows, field.free_count))]
        self._free = torch.from_numpy(free)
        self._mixing = None if field.mixing is None else field.mixing[free]

    @property
    def nbytes(self) -> int:
        """Memory held [bytes]."""
        mixing = self._mixing
        extra = 0 if mixing is None else mixing.data.nbytes + mixing.indices.nbytes + mixing.indptr.nbytes
        return int(self.rows.nbytes + self._free.nbytes + extra)

    def values(self, theta: Tensor) -> Tensor:
        """Free rows before the squash ``[V_free, 3]``, without history."""
        self.field.check_theta(theta)
        flat = theta.detach().reshape(-1, 3)
        if self._mixing is None:
            return torch.from_numpy(flat.numpy().take(self._free.numpy(), axis=0))
        return torch.from_numpy(self._mixing.astype(flat.numpy().dtype, copy=False) @ flat.numpy())

    def colours(self, values: Tensor) -> Tensor:
        """Colours ``[V, 3]`` of the rows, from the free rows' ``values``."""
        fixed = self.field.fixed_colours[self.rows[len(self._free) :] - self.field.free_count]
        return torch.cat([squash(values), torch.as_tensor(fixed, dtype=values.dtype).reshape(-1, 3)])

    def gradient(self, values: Tensor, grad_colours: Tensor) -> Tensor:
        """Gradient with respect to ``theta`` ``[parameter_count, 3]`` from one with respect to the rows' colours ``[V, 3]``."""
        slopes = grad_colours[: len(self._free)] * squash_derivative(values)
        if self._mixing is not None:
            return torch.from_numpy(self._mixing.T.astype(slopes.numpy().dtype, copy=False) @ slopes.numpy())
        out = torch.zeros(self.field.parameter_count, 3, dtype=values.dtype)
        out[self._free] = slopes
        return out


def compact(weights: SparseRows, field: ColouredObject) -> tuple[SparseRows, SeenRows]:
    """Weights ``[P, slots]`` with only the used columns ``[P, V]``, and the rows of these."""
    columns = np.empty_like(weights.columns)
    rows = _pack(weights.columns, scratch("place", weights.width, np.int32), columns)
    return SparseRows(weights.ends, columns, weights.values, len(rows)), SeenRows(field, rows)


@njit(**KERNEL_OPTIONS)
def _pack(
    indices: NDArray[np.int32], place: NDArray[np.int32], packed: NDArray[np.int32]
) -> NDArray[np.int64]:
    """The distinct ``indices``, ascending; ``packed`` gets each index's number among them. ``place`` is zero before and after."""
    count = 0
    for n in range(indices.shape[0]):
        index = np.uint64(indices[n])  # numba checks a signed one for counting from the end
        count += 1 - place[index]
        place[index] = 1
    rows, found, at = np.empty(count + 1, np.int64), 0, 0
    while found < count:
        # Without a branch, which would be unpredictable.
        is_there = place[np.uint64(at)]
        rows[np.uint64(found)] = at
        found += is_there
        place[np.uint64(at)] = found * is_there
        at += 1
    for n in range(indices.shape[0]):
        packed[n] = place[np.uint64(indices[n])] - 1
    for n in range(count):
        place[np.uint64(rows[n])] = 0
    return rows[:count]
