"""Image augmentation for training: what differs between cameras and between a surrogate and a camera, not the geometry.

The changes of a batch are drawn first. A kernel then makes each image in one pass from uint8 to float32, so that threads share a batch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.parallel import KERNEL_OPTIONS, scratch

# Noise is cut from one bank at random places: drawing fresh normal numbers would cost more than all the rest together.
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


@dataclass(frozen=True)
class Changes:
    """The changes of some images, as drawn; a slice of them belongs to the same slice of the images.

    Attributes:
        tables: Tone curves ``[B, 256, 3]`` float32, by grey level and channel.
        blurred: Whether each image is blurred ``[B]``.
        shifts: Shift to the right and down ``[B, 2]`` [px].
        noise: Standard deviation of each image's noise ``[B]`` float32.
        noise_starts: Place of each image's noise in the bank ``[B]``.
    """

    tables: NDArray[np.float32]
    blurred: NDArray[np.bool_]
    shifts: NDArray[np.int64]
    noise: NDArray[np.float32]
    noise_starts: NDArray[np.int64]

    @staticmethod
    def drawn(count: int, config: AugmentConfig, rng: np.random.Generator) -> Changes:
        """Changes of ``count`` images; the same ``rng`` gives the same ones."""
        tables = _tone_tables(count, config, rng)
        blurred = rng.random(count) < config.blur_share
        shifts = rng.integers(-config.shift_px, config.shift_px + 1, (count, 2))
        noise = np.float32(config.noise) * rng.random(count, dtype=np.float32)
        return Changes(tables, blurred, shifts, noise, rng.integers(0, NOISE_BANK, count))

    def __getitem__(self, rows: slice) -> Changes:
        return Changes(
            self.tables[rows],
            self.blurred[rows],
            self.shifts[rows],
            self.noise[rows],
            self.noise_starts[rows],
        )

    def applied(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Changed copies ``[B, H, W, 3]`` float32 0..1 of RGB images ``[B, H, W, 3]``."""
        _, height, width, _ = images.shape
        result = np.empty(images.shape, np.float32)
        rows = scratch("augment", 3 * width * (height + 2), np.uint16)
        bank = noise_bank(height * width * 3)
        changes = (self.tables, self.blurred, self.shifts, self.noise, self.noise_starts)
        _apply(np.ascontiguousarray(images), *changes, bank, rows, result)
        return result


@cache
def noise_bank(values: int) -> NDArray[np.float32]:
    """Normal numbers ``[NOISE_BANK + values]``, the same in every process."""
    return np.random.default_rng(0).standard_normal(NOISE_BANK + values, dtype=np.float32)


def _tone_tables(count: int, config: AugmentConfig, rng: np.random.Generator) -> NDArray[np.float32]:
    """Tone curves ``[B, 256, 3]``: gamma, contrast and channel gains about mid grey, brightness."""

    def uniform(channels: int = 1) -> NDArray[np.float64]:
        return rng.uniform(-1.0, 1.0, (count, 1, channels))

    level = np.linspace(0.0, 1.0, 256)[None, :, None]
    curve = level ** np.exp(config.gamma * uniform())
    gain = (1.0 + config.contrast * uniform()) * (1.0 + config.colour * uniform(3))
    return ((curve - 0.5) * gain + 0.5 + config.brightness * uniform()).astype(np.float32)


@njit(**KERNEL_OPTIONS)
def _apply(
    images: Any,
    tables: Any,
    blurred: Any,
    shifts: Any,
    noise: Any,
    noise_starts: Any,
    bank: Any,
    rows: Any,
    result: Any,
) -> None:
    """Shift (the border repeated), blur (binomial, rounded like OpenCV's), tone curve, noise; clipped to 0..1."""
    count, height, width, _ = images.shape
    size = 3 * width
    for index in range(count):
        image, table, out = images[index].reshape(height, size), tables[index], result[index].reshape(-1)
        right, down, blur = shifts[index, 0], shifts[index, 1], blurred[index]
        level, start = noise[index], noise_starts[index]
        # The shifted image with a border row on each side; blurred across (times 4) if it is to be blurred.
        for y in range(height + 2):
            source = min(max(min(max(y - 1, 0), height - 1) - down, 0), height - 1)
            row = rows[y * size : (y + 1) * size]
            _shift_row(image[source], 3 * right, row)
            if blur:
                _blur_row(row)
        for y in range(height):
            above, row, below = rows[y * size :], rows[(y + 1) * size :], rows[(y + 2) * size :]
            if blur:  # into the row above, which is not needed any more
                for i in range(size):
                    above[i] = (above[i] + 2 * row[i] + below[i] + 8) >> 4
                row = above
            seen, added = out[y * size : (y + 1) * size], bank[start + y * size :]
            for x in range(width):
                for k in range(3):
                    seen[3 * x + k] = table[row[3 * x + k], k]
            for i in range(size):
                value = seen[i] + level * added[i]
                value = np.float32(0.0) if value < 0.0 else value
                seen[i] = np.float32(1.0) if value > 1.0 else value


@njit(**KERNEL_OPTIONS)
def _shift_row(source: Any, right: int, row: Any) -> None:
    """Shift a row of RGB by ``right`` values, a multiple of 3; the border is repeated."""
    size = len(source)
    first, last = min(max(right, 0), size), max(min(size + right, size), 0)
    for i in range(first):
        row[i] = source[i % 3]
    for i in range(first, last):
        row[i] = source[i - right]
    for i in range(last, size):
        row[i] = source[size - 3 + i % 3]


@njit(**KERNEL_OPTIONS)
def _blur_row(row: Any) -> None:
    """Four times the binomial mean of three neighbours in a row of RGB, in place; the border is repeated."""
    size = len(row)
    for k in range(3):
        before = row[k]
        for i in range(k, size, 3):
            here = row[i]
            row[i] = before + 2 * here + row[min(i + 3, size - 3 + k)]
            before = here
