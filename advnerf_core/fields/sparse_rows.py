"""Sparse rows for casts, frames and gradients.

The arrays equal those of SciPy's CSR matrix. SciPy examines them whenever a matrix is made or cut, which for one object's part of one
frame takes longer than the product itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse

from advnerf_core.parallel import KERNEL_OPTIONS

# Sums keep their order and are not contracted: images and gradients have the bits of SciPy's product on every machine, and each row
# is too short to gain by vector instructions.
_ORDERED = {**KERNEL_OPTIONS, "fastmath": False}


@dataclass(frozen=True, eq=False)
class SparseRows:
    """A sparse matrix ``[P, V]``, row by row.

    Attributes:
        ends: Row ``p`` has the entries ``ends[p]`` to ``ends[p + 1]``, ``[P + 1]`` int32.
        columns: Column of each entry ``[N]`` int32.
        values: Value of each entry ``[N]``.
        width: Number of columns V.
    """

    ends: NDArray[np.int32]
    columns: NDArray[np.int32]
    values: NDArray[Any]
    width: int

    def __len__(self) -> int:
        return len(self.ends) - 1

    @property
    def nbytes(self) -> int:
        """Memory held [bytes]."""
        return self.ends.nbytes + self.columns.nbytes + self.values.nbytes

    def csr(self) -> sparse.csr_matrix:
        """The same as a matrix of SciPy, which shares the arrays if possible."""
        return sparse.csr_matrix((self.values, self.columns, self.ends), (len(self), self.width))

    def take(self, rows: NDArray[np.int64]) -> SparseRows:
        """The ``rows [R]`` alone, in new arrays."""
        return self.scaled(rows, np.ones(len(rows)))

    def scaled(self, rows: NDArray[np.int64], factors: NDArray[Any]) -> SparseRows:
        """The ``rows [R]`` alone, each times its factor ``[R]``."""
        factors = np.ascontiguousarray(factors, self.values.dtype)
        ends, columns, values = _scaled(
            self.ends, self.columns, self.values, np.ascontiguousarray(rows), factors
        )
        return SparseRows(ends, columns, values, self.width)

    def add_product(self, values: NDArray[Any], rows: NDArray[np.int64], out: NDArray[Any]) -> None:
        """Add the product with ``values [V, 3]`` to the ``rows [P]`` of ``out [N, 3]``."""
        _add_product(self.ends, self.columns, self.values, values, rows, out)

    def transposed_product(self, values: NDArray[Any]) -> NDArray[Any]:
        """The product ``[V, 3]`` of the transpose with ``values [P, 3]``."""
        out = np.zeros((self.width, 3), np.result_type(self.values, values))
        _add_transposed(self.ends, self.columns, self.values, np.ascontiguousarray(values), out)
        return out


# Indices are unsigned here, because numba checks each signed one for counting from the end.
@njit(**_ORDERED)
def _scaled(ends: Any, columns: Any, values: Any, rows: Any, factors: Any) -> Any:
    begins = np.zeros(len(rows) + 1, np.int32)
    for r in range(len(rows)):
        begins[r + 1] = begins[r] + ends[rows[r] + 1] - ends[rows[r]]
    kept_columns, kept = np.empty(begins[-1], columns.dtype), np.empty(begins[-1], values.dtype)
    for r in range(len(rows)):
        first, begin, factor = np.uint64(ends[rows[r]]), np.uint64(begins[r]), factors[r]
        for n in range(np.uint64(begins[r + 1] - begins[r])):
            kept_columns[begin + n] = columns[first + n]
            kept[begin + n] = values[first + n] * factor
    return begins, kept_columns, kept


@njit(**_ORDERED)
def _add_product(ends: Any, columns: Any, values: Any, factors: Any, rows: Any, out: Any) -> None:
    for p in range(len(rows)):
        red = green = blue = values.dtype.type(0.0)
        for n in range(np.uint64(ends[p]), np.uint64(ends[p + 1])):
            value, column = values[n], np.uint64(columns[n])
            red += value * factors[column, 0]
            green += value * factors[column, 1]
            blue += value * factors[column, 2]
        row = np.uint64(rows[p])
        out[row, 0] += red
        out[row, 1] += green
        out[row, 2] += blue


@njit(**_ORDERED)
def _add_transposed(ends: Any, columns: Any, values: Any, factors: Any, out: Any) -> None:
    for p in range(len(ends) - 1):
        red, green, blue = factors[p, 0], factors[p, 1], factors[p, 2]
        for n in range(np.uint64(ends[p]), np.uint64(ends[p + 1])):
            value, column = values[n], np.uint64(columns[n])
            out[column, 0] += value * red
            out[column, 1] += value * green
            out[column, 2] += value * blue
