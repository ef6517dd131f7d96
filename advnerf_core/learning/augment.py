"""Image augmentation for training: what differs between cameras and between a surrogate and a camera, not the geometry.

It works on uint8 images with OpenCV, where a filter or a tone curve costs a tenth of what it costs on a float tensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

# Noise is cut from a bank at random places: drawing fresh normal numbers would cost more than all the rest together.
NOISE_BANK = 1 << 19


@dataclass(frozen=True)
class AugmentConfig:
    """Strength of each change; every image of a batch draws its own. Zero switches one off.

    Attributes:
        brightness: Largest added grey level, of a 0..1 range.
        contrast: Largest relative change of contrast about mid grey.
        gamma: Largest logarithmic change of the tone curve's exponent.
        colour: Largest relative gain change of a single channel.
        noise: Standard deviation of Gaussian pixel noise; each image draws its own level up to this.
        blur_share: Share of the images that are blurred by a 3x3 binomial filter.
        shift_px: Largest shift in whole pixels, both axes; one pixel is about 0.5 degrees.
    """

    brightness: float = 0.10
    contrast: float = 0.20
    gamma: float = 0.25
    colour: float = 0.08
    noise: float = 0.03
    blur_share: float = 0.35
    shift_px: int = 1


def augment(
    images: NDArray[np.uint8], config: AugmentConfig, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Changed copies ``[B, H, W, 3]`` float32 0..1 of RGB images ``[B, H, W, 3]``; the same ``rng`` gives the same result."""
    count, height, width, _ = images.shape
    tables = _tone_tables(count, config, rng)
    blurred = rng.random(count) < config.blur_share
    shifts = (
        rng.integers(-config.shift_px, config.shift_px + 1, (count, 2))
        if config.shift_px
        else np.zeros((count, 2))
    )
    result = np.empty(images.shape, np.float32)
    for index in range(count):
        image = images[index]
        if shifts[index].any():
            matrix = np.array([[1.0, 0.0, shifts[index, 0]], [0.0, 1.0, shifts[index, 1]]])
            image = cv2.warpAffine(
                image, matrix, (width, height), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
            )
        if blurred[index]:
            image = cv2.GaussianBlur(image, (3, 3), 0.0, borderType=cv2.BORDER_REPLICATE)
        result[index] = cv2.LUT(image, tables[index][None])
    if config.noise > 0.0:
        _add_noise(result, config.noise, rng)
    return np.clip(result, 0.0, 1.0, out=result)


def _tone_tables(count: int, config: AugmentConfig, rng: np.random.Generator) -> NDArray[np.float32]:
    """Tone curves ``[B, 256, 3]``: gamma, contrast and channel gains about mid grey, brightness."""

    def uniform(channels: int = 1) -> NDArray[np.float64]:
        return rng.uniform(-1.0, 1.0, (count, 1, channels))

    level = np.linspace(0.0, 1.0, 256)[None, :, None]
    curve = level ** np.exp(config.gamma * uniform())
    gain = (1.0 + config.contrast * uniform()) * (1.0 + config.colour * uniform(3))
    return ((curve - 0.5) * gain + 0.5 + config.brightness * uniform()).astype(np.float32)


def _add_noise(images: NDArray[np.float32], largest: float, rng: np.random.Generator) -> None:
    flat = images.reshape(len(images), -1)
    bank = rng.standard_normal(NOISE_BANK + flat.shape[1], dtype=np.float32)
    levels = largest * rng.random(len(images), dtype=np.float32)
    for row, level, start in zip(flat, levels, rng.integers(0, NOISE_BANK, len(images)), strict=True):
        row += level * bank[start : start + len(row)]
