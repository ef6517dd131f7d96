import torch

from advnerf_core.render.composite import composite, visible_shares


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
