import math

import numpy as np
import pytest

from advnerf_core.scene.colour import IDENTITY, ColourMap, fit_colour_map
from advnerf_core.scene.metrics import gain_fitted, psnr, ssim

RNG = np.random.default_rng(0)


def test_fit_recovers_a_map_despite_displaced_edges() -> None:
    true = ColourMap(((0.9, 0.1, 0.0), (0.05, 0.8, 0.1), (0.0, 0.1, 0.85)), (0.01, 0.0, 0.02), 1.3)
    learned = RNG.random((2000, 3)).astype(np.float32)
    driving = true.apply(learned)
    driving[:80] = RNG.random((80, 3))
    found = fit_colour_map(learned, driving)
    np.testing.assert_allclose(found.apply(learned[80:]), driving[80:], atol=5e-3)
    assert found.power == pytest.approx(1.3, abs=0.02)


def test_a_fit_to_many_pixels_takes_a_fixed_sample_of_them() -> None:
    true = ColourMap(((0.9, 0.1, 0.0), (0.05, 0.8, 0.1), (0.0, 0.1, 0.85)), (0.01, 0.0, 0.02), 0.8)
    learned = RNG.random((400, 500, 3)).astype(np.float32)
    driving = np.rint(255.0 * true.apply(learned)).astype(np.uint8)
    learned[:5] = np.nan  # rays that met nothing
    found = fit_colour_map(learned, driving)
    assert found == fit_colour_map(learned, driving)
    test = RNG.random((1000, 3)).astype(np.float32)
    np.testing.assert_allclose(found.apply(test), true.apply(test), atol=2e-3)


def test_identity_changes_nothing_and_maps_survive_json() -> None:
    image = RNG.random((2, 4, 5, 3)).astype(np.float32)
    np.testing.assert_allclose(IDENTITY.apply(image), image, atol=1e-6)
    other = ColourMap(((0.9, 0.1, 0.0), (0.05, 0.8, 0.1), (0.0, 0.1, 0.85)), (0.01, 0.0, 0.02), 1.3)
    assert ColourMap.from_dict(other.to_dict()) == other


def test_too_few_pairs_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 16"):
        fit_colour_map(np.zeros((3, 3)), np.zeros((3, 3)))


def test_psnr_of_a_known_error() -> None:
    a = np.full((8, 8, 3), 0.5)
    assert psnr(a + 0.1, a) == pytest.approx(20.0)
    assert psnr(np.full((4, 4, 3), 255, np.uint8), np.ones((4, 4, 3))) == math.inf
    with pytest.raises(ValueError, match="one shape"):
        psnr(a, a[:4])


def test_a_fitted_gain_takes_brightness_and_tint_out_and_nothing_else() -> None:
    picture, gains = 0.1 + 0.5 * RNG.random((16, 16, 3)), np.array([1.2, 0.7, 1.0])
    np.testing.assert_allclose(gain_fitted(picture, picture * gains), picture * gains, atol=1e-12)
    offset = picture + 0.1
    assert 20.0 < psnr(gain_fitted(picture, offset), offset) < 40.0  # an offset is no gain
    opacity = RNG.random((16, 16, 1))
    ours, theirs = (opacity * each + (1.0 - opacity) for each in (picture, picture * gains))
    np.testing.assert_allclose(gain_fitted(ours, theirs, 1.0 - opacity), theirs, atol=1e-12)
    with pytest.raises(ValueError, match="one shape"):
        gain_fitted(picture, picture[:4])


def test_ssim_of_constant_images_is_the_luminance_term() -> None:
    a, b = np.full((20, 20, 3), 0.4), np.full((20, 20, 3), 0.6)
    expected = (2 * 0.4 * 0.6 + 1e-4) / (0.4**2 + 0.6**2 + 1e-4)
    assert ssim(a, b) == pytest.approx(expected, abs=1e-6)
    noise = RNG.random((20, 20, 3))
    assert ssim(noise, noise) == pytest.approx(1.0)
    assert ssim(noise, 1 - noise) < 0
