"""Colours of an object as a sum of trilinear grids from coarse to fine, as in the public code of the method we follow.

The levels are added on the object's own voxels and squashed there, before voxels are interpolated along a ray: a picture stays
linear in squashed colours, and rendering is the same sparse product as for a plain grid. Coarse levels move many voxels at once,
which spreads a gradient; the price is more parameters and a larger product. Dense grids are the default.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from advnerf_core.fields.voxel_grid import VoxelGridObject


def with_summed_levels(
    field: VoxelGridObject, levels: int = 16, coarsest: int = 2, finest: int = 64
) -> VoxelGridObject:
    """The same object with its free colours given by summed levels instead of one value each.

    Args:
        field: An object whose free rows are given directly. A row that several voxels show takes their mean.
        levels: Number of grids; each spans the object's box, with ``n^3`` cells at whose centres the values sit.
        finest: Cells along an edge of the last grid; sizes between grow geometrically, and equal sizes are kept once.

    Returns:
        An object with ``theta_shape (parameters, 3)``; its geometry is shared.
    """
    if levels < 1 or not 1 <= coarsest <= finest or field.mixing is not None:
        raise ValueError(
            f"expected at least one level from coarse to fine on an object without levels, got {levels} from {coarsest} "
            f"to {finest}"
        )
    sizes = sorted({round(float(n)) for n in np.geomspace(coarsest, finest, levels)})
    voxels = np.argwhere(field.slots < field.free_count)
    rows = field.slots[tuple(voxels.T)].astype(np.int64)
    places = (voxels + 0.5) / field.slots.shape
    mixing = sparse.hstack([_level(places, n) for n in sizes], format="csr")
    shown = np.bincount(rows, minlength=field.free_count)
    mean = sparse.csr_matrix((1.0 / shown[rows], (rows, np.arange(len(rows)))), (field.free_count, len(rows)))
    parameters = int(sum(n**3 for n in sizes))
    # The plain colours belong to the rows, for any mixing.
    plain = field.plain_colours
    changed = replace(
        field, theta_shape=(parameters, 3), mixing=sparse.csr_matrix(mean @ mixing), plain_colours=plain
    )
    object.__setattr__(changed, "derived", field.derived)
    return changed


def _level(places: NDArray[np.float64], cells: int) -> sparse.csr_matrix:
    """Trilinear interpolation of a grid of ``cells^3`` values at ``places [N, 3]`` in 0..1, ``[N, cells^3]``."""
    g = np.clip(places * cells - 0.5, 0.0, cells - 1.0)
    first = np.minimum(g.astype(np.int64), max(cells - 2, 0))
    share = g - first
    columns, values = [], []
    for corner in np.ndindex(2, 2, 2):
        index = np.minimum(first + corner, cells - 1)
        columns.append((index[:, 0] * cells + index[:, 1]) * cells + index[:, 2])
        values.append(np.prod(np.where(corner, share, 1.0 - share), axis=1))
    rows = np.tile(np.arange(len(places)), 8)
    matrix = sparse.coo_matrix(
        (np.concatenate(values), (rows, np.concatenate(columns))), (len(places), cells**3)
    ).tocsr()
    matrix.eliminate_zeros()
    return matrix
