import cv2
import numpy as np
import pytest

from advnerf_core.learning.augment import AugmentConfig, Changes, noise_bank

OFF = AugmentConfig(
    brightness=0.0, contrast=0.0, gamma=0.0, colour=0.0, noise=0.0, blur_share=0.0, shift_px=0
)


def augment(images: np.ndarray, config: AugmentConfig, rng: np.random.Generator) -> np.ndarray:
    return Changes.drawn(len(images), config, rng).applied(images)


def _images() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (16, 66, 200, 3), dtype=np.uint8)


def test_strength_zero_only_scales() -> None:
    np.testing.assert_allclose(augment(_images(), OFF, np.random.default_rng()), _images() / 255.0, atol=1e-6)


def test_same_generator_same_result_within_range() -> None:
    first = augment(_images(), AugmentConfig(), np.random.default_rng(1))
    assert first.dtype == np.float32
    np.testing.assert_array_equal(first, augment(_images(), AugmentConfig(), np.random.default_rng(1)))
    assert not np.array_equal(first, augment(_images(), AugmentConfig(), np.random.default_rng(2)))
    assert first.min() >= 0.0
    assert first.max() <= 1.0


def test_noise_level_and_blur() -> None:
    grey = np.full((64, 66, 200, 3), 128, np.uint8)
    noisy = augment(
        grey, AugmentConfig(0, 0, 0, 0, noise=0.1, blur_share=0, shift_px=0), np.random.default_rng(0)
    )
    levels = noisy.std(axis=(1, 2, 3))
    assert levels.min() < 0.03
    assert 0.08 < levels.max() < 0.11
    dot = np.zeros((1, 66, 200, 3), np.uint8)
    dot[:, 30, 100] = 240
    blurred = augment(dot, AugmentConfig(0, 0, 0, 0, 0, blur_share=1.0, shift_px=0), np.random.default_rng(0))
    expected = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) * 15 / 255
    np.testing.assert_allclose(blurred[0, 29:32, 99:102, 0], expected, atol=1e-6)


def test_tone_curves_are_per_image_and_per_channel() -> None:
    grey = np.full((8, 66, 200, 3), 60, np.uint8)
    toned = augment(grey, AugmentConfig(noise=0.0), np.random.default_rng(0))
    assert np.ptp(toned, axis=(1, 2)).max() < 1e-6
    assert len(np.unique(toned[:, 0, 0].round(5))) == 24


def test_shift_moves_by_whole_pixels() -> None:
    moved = augment(_images(), AugmentConfig(0, 0, 0, 0, 0, 0, shift_px=1), np.random.default_rng(3))
    inner = (slice(2, -2), slice(2, -2))
    candidates = [np.roll(_images(), (dy, dx), (1, 2)) / 255.0 for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    found = [
        [np.allclose(image[inner], c[i][inner], atol=1e-6) for c in candidates]
        for i, image in enumerate(moved)
    ]
    assert all(sum(row) == 1 for row in found)
    assert len({row.index(True) for row in found}) > 3


@pytest.mark.parametrize("shift_px", [0, 1, 3])
def test_the_kernel_equals_opencv_to_rounding(shift_px: int) -> None:
    images = _images()
    changes = Changes.drawn(len(images), AugmentConfig(shift_px=shift_px), np.random.default_rng(shift_px))
    assert 0 < changes.blurred.sum() < len(images)
    expected = np.stack([_with_opencv(image, changes[i : i + 1]) for i, image in enumerate(images)])
    np.testing.assert_allclose(changes.applied(images), expected, atol=2e-7)


def _with_opencv(image: np.ndarray, change: Changes) -> np.ndarray:
    height, width, _ = image.shape
    matrix = np.array([[1.0, 0.0, change.shifts[0, 0]], [0.0, 1.0, change.shifts[0, 1]]])
    moved = cv2.warpAffine(
        image, matrix, (width, height), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
    )
    if change.blurred[0]:
        moved = cv2.GaussianBlur(moved, (3, 3), 0.0, borderType=cv2.BORDER_REPLICATE)
    start = change.noise_starts[0]
    noise = change.noise[0] * noise_bank(image.size)[start : start + image.size].reshape(image.shape)
    return np.clip(cv2.LUT(moved, change.tables[0][None]) + noise, 0.0, 1.0)


def test_a_slice_of_the_changes_belongs_to_the_same_images() -> None:
    images, changes = _images(), Changes.drawn(16, AugmentConfig(), np.random.default_rng(4))
    np.testing.assert_array_equal(changes.applied(images)[5:9], changes[5:9].applied(images[5:9]))
