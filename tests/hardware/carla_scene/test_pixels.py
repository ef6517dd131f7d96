"""Bytes of images, against CARLA's published formula worked backwards."""

from types import SimpleNamespace

import numpy as np
import pytest

from hardware.worlds.carla.errors import CarlaFrameError
from hardware.worlds.carla.pixels import depth_of, rgb_of


def image(bgra):
    return SimpleNamespace(
        width=bgra.shape[1], height=bgra.shape[0], raw_data=bgra.astype(np.uint8).tobytes()
    )


def test_colours_lose_alpha_and_are_turned_round():
    bgra = np.array([[[1, 2, 3, 255], [4, 5, 6, 0]]])
    np.testing.assert_array_equal(rgb_of(image(bgra), 2, 1), [[[3, 2, 1], [6, 5, 4]]])


def test_depth_in_each_byte():
    """One step of R, G and B is 1, 256 and 65536 steps of 1000 m / (2^24 - 1)."""
    bgra = np.array([[[0, 0, 1, 9], [0, 1, 0, 9], [1, 0, 0, 9], [10, 200, 30, 9], [255, 255, 255, 9]]])
    step = 1000.0 / 16777215.0
    expected = [step, 256 * step, 65536 * step, (30 + 200 * 256 + 10 * 65536) * step, np.inf]
    np.testing.assert_allclose(depth_of(image(bgra), 5, 1)[0], expected, rtol=1e-6)


def test_depth_comes_back_to_a_tenth_of_a_millimetre():
    truth = np.random.default_rng(0).uniform(0.0, 300.0, (6, 8))
    steps = np.rint(truth / 1000.0 * (256**3 - 1)).astype(np.uint32)
    bgra = np.stack([steps >> 16 & 255, steps >> 8 & 255, steps & 255, 0 * steps], axis=-1)
    np.testing.assert_allclose(depth_of(image(bgra), 8, 6), truth, atol=1e-4)


def test_wrong_size_is_said():
    with pytest.raises(
        CarlaFrameError, match="expected an image of 4 x 3 pixels in BGRA, got 3 x 4 in 48 bytes"
    ):
        rgb_of(image(np.zeros((4, 3, 4))), 4, 3)
