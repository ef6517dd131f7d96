import numpy as np
import pytest
from numpy.typing import DTypeLike
from scipy import sparse

from advnerf_core.fields.sparse_rows import SparseRows


def some_rows(
    rows: int = 40, width: int = 30, dtype: DTypeLike = np.float32
) -> tuple[SparseRows, sparse.csr_matrix]:
    dense = np.random.default_rng(0).random((rows, width)) * (
        np.random.default_rng(1).random((rows, width)) < 0.2
    )
    csr = sparse.csr_matrix(dense.astype(dtype))
    return SparseRows(csr.indptr, csr.indices, csr.data, width), csr


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_products_are_those_of_scipy(dtype: DTypeLike) -> None:
    rows, csr = some_rows(dtype=dtype)
    rng = np.random.default_rng(2)
    colours, gradient = rng.random((30, 3)).astype(dtype), rng.random((40, 3)).astype(dtype)
    picture, where = rng.random((100, 3)).astype(dtype), rng.permutation(100)[:40]
    expected = picture.copy()
    expected[where] += csr @ colours
    rows.add_product(colours, where, picture)
    np.testing.assert_array_equal(picture, expected)
    np.testing.assert_array_equal(rows.transposed_product(gradient), csr.T @ gradient)


def test_rows_are_taken_and_scaled_in_arrays_of_their_own() -> None:
    rows, csr = some_rows()
    chosen, factors = np.array([3, 0, 39, 3]), np.array([0.5, 2.0, 1.0, 0.25])
    np.testing.assert_array_equal(rows.take(chosen).csr().toarray(), csr[chosen].toarray())
    scaled = rows.scaled(chosen, factors)
    np.testing.assert_array_equal(
        scaled.csr().toarray(), csr[chosen].toarray() * factors[:, None].astype(np.float32)
    )
    assert not np.shares_memory(scaled.values, rows.values)
    assert len(scaled) == 4
    assert scaled.nbytes == 5 * 4 + len(scaled.values) * (4 + 4)


def test_no_rows_give_nothing() -> None:
    nothing = some_rows()[0].take(np.zeros(0, np.int64))
    assert len(nothing) == 0
    np.testing.assert_array_equal(nothing.transposed_product(np.zeros((0, 3), np.float32)), np.zeros((30, 3)))
