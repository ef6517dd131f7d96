import torch

from advnerf_core.driving.augment import AugmentConfig, augment

OFF = AugmentConfig(brightness=0.0, contrast=0.0, gamma=0.0, colour=0.0, noise=0.0, blur_share=0.0, shift_px=0)


def _images() -> torch.Tensor:
    return torch.rand(16, 3, 66, 200, generator=torch.Generator().manual_seed(0))


def test_strength_zero_changes_nothing() -> None:
    torch.testing.assert_close(augment(_images(), OFF, torch.Generator()), _images(), atol=2e-4, rtol=0)


def test_same_generator_same_result_within_range() -> None:
    first = augment(_images(), AugmentConfig(), torch.Generator().manual_seed(1))
    assert torch.equal(first, augment(_images(), AugmentConfig(), torch.Generator().manual_seed(1)))
    assert not torch.equal(first, augment(_images(), AugmentConfig(), torch.Generator().manual_seed(2)))
    assert float(first.min()) >= 0.0
    assert float(first.max()) <= 1.0


def test_noise_level_and_blur() -> None:
    grey = torch.full((64, 3, 66, 200), 0.5)
    noisy = augment(
        grey, AugmentConfig(0, 0, 0, 0, noise=0.1, blur_share=0, shift_px=0), torch.Generator().manual_seed(0)
    )
    levels = noisy.std(dim=(1, 2, 3))
    assert float(levels.min()) > 0.0
    assert 0.08 < float(levels.max()) < 0.11
    dot = torch.zeros(1, 3, 66, 200)
    dot[..., 30, 100] = 1.0
    blurred = augment(dot, AugmentConfig(0, 0, 0, 0, 0, blur_share=1.0, shift_px=0), torch.Generator())
    torch.testing.assert_close(
        blurred[0, 0, 29:32, 99:102], torch.tensor([[1.0, 2, 1], [2, 4, 2], [1, 2, 1]]) / 16, atol=2e-4, rtol=0
    )


def test_shift_moves_by_whole_pixels() -> None:
    config = AugmentConfig(0, 0, 0, 0, 0, 0, shift_px=1)
    moved = augment(_images(), config, torch.Generator().manual_seed(3))
    candidates = [torch.roll(_images(), (dy, dx), (2, 3)) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    inner = (..., slice(2, -2), slice(2, -2))
    assert any(torch.allclose(moved[inner], candidate[inner], atol=2e-4) for candidate in candidates)
