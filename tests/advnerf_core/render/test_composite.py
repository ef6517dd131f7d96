import numpy as np
import pytest
import torch

from advnerf_core.render.composite import sparse_shares, visible_shares
from tests.support.layers import composite


def test_three_layers_follow_the_formula_nearest_first():
    # One pixel; layers given out of order: depths 3, 1, 2.
    colour = torch.tensor([[[0.9]], [[0.1]], [[0.5]]])
    alpha = torch.tensor([[0.5], [0.25], [0.4]])
    depth = torch.tensor([[3.0], [1.0], [2.0]])
    image, total, _ = composite(colour * alpha[..., None], alpha, depth)
    expected = 0.1 * 0.25 + 0.75 * (0.5 * 0.4) + 0.75 * 0.6 * (0.9 * 0.5)
    torch.testing.assert_close(image, torch.tensor([[expected]]))
    torch.testing.assert_close(total, torch.tensor([1 - 0.75 * 0.6 * 0.5]))


def test_order_is_per_pixel_and_the_order_of_arguments_does_not_matter():
    generator = torch.Generator().manual_seed(0)
    alpha = torch.rand((4, 5, 7), generator=generator)
    depth = torch.rand((4, 5, 7), generator=generator)
    colour = torch.rand((4, 5, 7, 3), generator=generator) * alpha[..., None]
    image, total, depth_out = composite(colour, alpha, depth)
    permutation = torch.tensor([2, 0, 3, 1])
    shuffled = composite(colour[permutation], alpha[permutation], depth[permutation])
    for a, b in zip((image, total, depth_out), shuffled, strict=True):
        torch.testing.assert_close(a, b)
    # Independent truth: blend back to front, pixel by pixel.
    for r in range(5):
        for c in range(7):
            blend = torch.zeros(3)
            for k in sorted(range(4), key=lambda i, r=r, c=c: -float(depth[i, r, c])):
                blend = colour[k, r, c] + (1 - alpha[k, r, c]) * blend
            torch.testing.assert_close(image[r, c], blend)


def test_an_opaque_layer_hides_what_is_behind_and_infinite_depth_of_nothing_is_harmless():
    alpha = torch.tensor([1.0, 1.0, 0.0])
    depth = torch.tensor([2.0, 1.0, torch.inf])
    assert visible_shares(alpha, depth).tolist() == [0.0, 1.0, 0.0]
    _, total, depth_out = composite(alpha[:, None], alpha, depth)
    assert total.item() == 1.0
    assert depth_out.item() == 1.0


def test_equal_depths_keep_the_order_of_the_layers():
    alpha = torch.tensor([[1.0], [1.0]])
    assert visible_shares(alpha, torch.zeros(2, 1)).squeeze().tolist() == [1.0, 0.0]


def test_sparse_layers_follow_the_dense_formula_in_any_order():
    generator = np.random.default_rng(3)
    count, layers = 40, 5
    pixels = [np.sort(generator.permutation(count)[: 5 + 7 * k]) for k in range(layers)]
    alphas = [generator.uniform(size=len(part)) for part in pixels]
    depths = [generator.uniform(1.0, 3.0, len(part)) for part in pixels]
    behind = generator.uniform(1.5, 4.0, count)
    behind[::9] = np.nan
    dense_alpha, dense_depth = (
        torch.zeros(layers + 1, count).double(),
        torch.full((layers + 1, count), torch.inf).double(),
    )
    for k, (part, alpha, depth) in enumerate(zip(pixels, alphas, depths, strict=True)):
        dense_alpha[k, part], dense_depth[k, part] = torch.from_numpy(alpha), torch.from_numpy(depth)
    dense_alpha[-1], dense_depth[-1] = 1.0, torch.from_numpy(np.nan_to_num(behind, nan=np.inf))
    expected = visible_shares(dense_alpha, dense_depth).numpy()
    for order in (range(layers), [3, 0, 4, 1, 2]):
        background, shares = sparse_shares(
            *([part[k] for k in order] for part in (pixels, alphas, depths)), behind
        )
        np.testing.assert_allclose(background, expected[-1], atol=1e-12)
        for k, share in zip(order, shares, strict=True):
            np.testing.assert_allclose(share, expected[k, pixels[k]], atol=1e-12)


def test_sparse_layers_of_equal_depth_keep_their_order_and_win_over_the_background():
    one = np.zeros(1, np.int64)
    background, shares = sparse_shares(
        [one, one], [np.array([0.25]), np.array([1.0])], [np.ones(1), np.ones(1)], np.ones(2)
    )
    assert [part.tolist() for part in shares] == [[1.0], [0.75]]
    assert background.tolist() == [0.0, 1.0]
    background, shares = sparse_shares([], [], [], np.ones(3))
    assert shares == []
    assert background.tolist() == [1.0, 1.0, 1.0]
    with pytest.raises(ValueError, match="expected pixels within"):
        sparse_shares([one + 2], [np.ones(1)], [np.ones(1)], np.ones(2))
