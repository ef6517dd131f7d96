import numpy as np

from advnerf_core.fields.mlp_kernels import TILE, add_outer, dense, dense_transposed

RNG = np.random.default_rng(0)
W, B = RNG.normal(size=(6, 8)).astype(np.float32), RNG.normal(size=6).astype(np.float32)
X = RNG.normal(size=(8, TILE)).astype(np.float32)


def test_dense_is_a_matrix_product() -> None:
    y = np.empty((6, TILE), np.float32)
    dense(W, B, X, y, False)
    np.testing.assert_allclose(y, W @ X + B[:, None], rtol=1e-5, atol=1e-5)
    dense(W, B, X, y, True)
    np.testing.assert_allclose(y, np.maximum(W @ X + B[:, None], 0), rtol=1e-5, atol=1e-5)


def test_gradients_are_its_transposes() -> None:
    grad = RNG.normal(size=(8, TILE)).astype(np.float32)
    weight = RNG.normal(size=(8, 8)).astype(np.float32)
    grad_x, mask = np.empty((8, TILE), np.float32), np.maximum(X, 0)
    dense_transposed(np.ascontiguousarray(weight.T), grad, mask, grad_x, True)
    np.testing.assert_allclose(grad_x, (weight.T @ grad) * (mask > 0), rtol=1e-4, atol=1e-5)
    grad_weight, grad_bias = np.ones((8, 8), np.float32), np.ones(8, np.float32)
    add_outer(grad, X, grad_weight, grad_bias)
    np.testing.assert_allclose(grad_weight, 1 + grad @ X.T, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(grad_bias, 1 + grad.sum(1), rtol=1e-4, atol=1e-4)
