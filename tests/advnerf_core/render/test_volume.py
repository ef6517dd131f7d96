"""Volume rendering against closed forms and automatic differentiation."""

import numpy as np
import torch
from numpy.typing import NDArray

from advnerf_core.fields.mlp_kernels import TILE
from advnerf_core.render.volume_kernels import (
    accumulate,
    accumulate_backward,
    add_distortion_gradient,
    mark_visible,
)

RNG = np.random.default_rng(0)
CHANNELS = 3
COUNTS = np.array([0, 1, 7, 300, 12])
BEGINS = np.concatenate([[0], np.cumsum(COUNTS)])
N, R = int(BEGINS[-1]), len(COUNTS)


def tiled(rows: NDArray[np.float64]) -> NDArray[np.float32]:
    """``[N, K]`` to tiles ``[tiles, K, TILE]``."""
    tiles = -(-len(rows) // TILE)
    padded = np.zeros((tiles * TILE, rows.shape[1]), np.float32)
    padded[: len(rows)] = rows
    return np.ascontiguousarray(padded.reshape(tiles, TILE, -1).transpose(0, 2, 1))


def untiled(tiles: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    return tiles.transpose(0, 2, 1).reshape(-1, tiles.shape[1])[:count]


def reference(raw: torch.Tensor, widths: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Weights, accumulated features and opacity in double precision, ray by ray."""
    weights, features, alphas = [], [], []
    for r in range(R):
        part = slice(BEGINS[r], BEGINS[r + 1])
        tau = torch.exp(raw[part, 0]) * widths[part]
        through = torch.exp(-(torch.cumsum(tau, 0) - tau))
        w = through * (1 - torch.exp(-tau))
        weights.append(w)
        features.append((w[:, None] * torch.nn.functional.softsign(raw[part, 1:])).sum(0))
        alphas.append(w.sum())
    return torch.cat(weights), torch.stack(features), torch.stack(alphas)


def problem() -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    raw = RNG.normal(size=(N, 1 + CHANNELS))
    widths = RNG.uniform(0.001, 0.02, N).astype(np.float32)  # thin enough that no ray stops early
    return raw, widths


def squashed(raw: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([raw[:, :1], raw[:, 1:] / (1 + np.abs(raw[:, 1:]))], axis=1)


def test_forward_and_backward_agree_with_automatic_differentiation() -> None:
    raw, widths = problem()
    field, out = tiled(squashed(raw)), np.zeros((1, 4, TILE), np.float32)
    weights, alpha = np.empty(N, np.float32), np.empty(R, np.float32)
    accumulate(field, widths, BEGINS, 0, R, weights, out, alpha)

    leaf = torch.from_numpy(raw).requires_grad_()
    true_weights, true_features, true_alpha = reference(leaf, torch.from_numpy(widths).double())
    np.testing.assert_allclose(weights, true_weights.detach(), atol=1e-6)
    np.testing.assert_allclose(untiled(out, R)[:, :CHANNELS], true_features.detach(), atol=1e-5)
    np.testing.assert_allclose(alpha, true_alpha.detach(), atol=1e-6)

    grad_features, grad_alpha = RNG.normal(size=(R, CHANNELS)), RNG.normal(size=R)
    direct = RNG.normal(size=N)
    loss = (true_features * torch.from_numpy(grad_features)).sum() + (
        true_alpha * torch.from_numpy(grad_alpha)
    ).sum()
    (loss + (true_weights * torch.from_numpy(direct)).sum()).backward()
    accumulate_backward(
        field,
        widths,
        BEGINS,
        0,
        R,
        weights,
        tiled(grad_features),
        grad_alpha.astype(np.float32),
        direct.astype(np.float32),
    )
    assert leaf.grad is not None
    np.testing.assert_allclose(untiled(field, N), leaf.grad, atol=2e-5)


def test_a_uniform_medium_follows_beer_and_lambert() -> None:
    raw, widths = np.zeros((N, 1 + CHANNELS)), np.full(N, 0.01, np.float32)
    raw[:, 0] = np.log(3.0)
    out, weights, alpha = np.zeros((1, 4, TILE), np.float32), np.empty(N, np.float32), np.empty(R, np.float32)
    accumulate(tiled(raw), widths, BEGINS, 0, R, weights, out, alpha)
    np.testing.assert_allclose(alpha, 1 - np.exp(-3.0 * 0.01 * COUNTS), atol=2e-4)


def test_samples_behind_a_wall_are_dropped() -> None:
    raw, widths = np.full((N, 1 + CHANNELS), 1.0), np.full(N, 0.01, np.float32)
    wall = BEGINS[3] + 10
    raw[wall, 0] = 12.0
    keep = np.ones(N, np.bool_)
    mark_visible(tiled(raw), widths, BEGINS, 0, R, np.float32(1e-4), keep)
    assert keep[BEGINS[3] : wall + 1].all()
    assert not keep[wall + 1 : BEGINS[4]].any()


def test_distortion_gradient_agrees_with_the_double_sum() -> None:
    weights, widths = RNG.uniform(0, 0.1, N), RNG.uniform(0.001, 0.01, N)
    middles = np.concatenate([np.sort(RNG.random(c)) for c in COUNTS])
    leaf, total = torch.from_numpy(weights).requires_grad_(), torch.zeros((), dtype=torch.float64)
    for r in range(R):
        part = slice(BEGINS[r], BEGINS[r + 1])
        w, m, d = leaf[part], torch.from_numpy(middles[part]), torch.from_numpy(widths[part])
        total = total + (w[:, None] * w * (m[:, None] - m).abs()).sum() + (w**2 * d).sum() / 3
    total.backward()
    grad = np.zeros(N, np.float32)
    single = [a.astype(np.float32) for a in (weights, middles, widths)]
    add_distortion_gradient(*single, BEGINS, 0, R, np.float32(1.0), grad)
    assert leaf.grad is not None
    np.testing.assert_allclose(grad, leaf.grad, atol=1e-4)
