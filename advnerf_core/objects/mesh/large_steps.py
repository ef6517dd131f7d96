"""The preconditioner of shape attacks: Nicolet, Jacobson and Jakob 2021, "Large Steps in Inverse Rendering of Geometry".

Vertices are moved by ``d = (I + lambda L)^-1 u`` with the mesh's combinatorial Laplacian ``L``; ``u`` is optimised. The inverse
spreads a gradient, which exists only where silhouettes and texture move, over the surface around. Mitsuba's ``mi.ad.LargeSteps`` is
the same matrix, but needs a solver that Mitsuba does not include; scipy's serves as well, in float64.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from advnerf_core.geometry import Array


class LargeSteps:
    """The symmetric matrix ``(I + lambda L)^-1`` of a mesh, factorised once.

    Args:
        vertex_count: Number of vertices, welded so that the surface stays closed.
        faces: Corners ``[F, 3]``.
        smoothness: Lambda; 0 moves each vertex independently. It should grow with the number of triangles.
    """

    def __init__(self, vertex_count: int, faces: NDArray[np.int32], smoothness: float = 19.0) -> None:
        if not 0.0 <= smoothness < np.inf:
            raise ValueError(f"expected a finite smoothness >= 0, got {smoothness}")
        self.matrix = (sparse.identity(vertex_count) + smoothness * laplacian(vertex_count, faces)).tocsc()
        self._factors = splu(self.matrix)

    def solve(self, right: Array) -> Array:
        """``(I + lambda L)^-1 right`` for ``[V, 3]``; it is its own transpose."""
        return np.asarray(self._factors.solve(np.ascontiguousarray(right, dtype=np.float64)))


def laplacian(vertex_count: int, faces: NDArray[np.int32]) -> sparse.csr_matrix:
    """Combinatorial Laplacian: number of neighbours on the diagonal, -1 for each neighbour."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    near = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), (vertex_count, vertex_count))
    return (sparse.diags(np.asarray(near.sum(axis=1)).ravel()) - near).tocsr()
