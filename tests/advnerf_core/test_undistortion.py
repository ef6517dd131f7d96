"""A ray through a pixel is drawn at that pixel, also by lenses as wide as their model allows."""

import cv2
import numpy as np
import pytest

from advnerf_core.undistortion import ray_slopes

WIDTH, HEIGHT = 160, 120
# r (1 - 0.3 r^2 + 0.09 r^4) never falls, so that each pixel has one ray: drawn to 70 degrees and more.
WIDE = (-0.3, 0.09, 0.0, 0.0, 0.0)
# This one folds at 62 degrees: what is farther out is drawn by no ray.
FOLDING = (-0.28, 0.07, 0.0, 0.0, -0.0075)


def pixels():
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.stack([u.ravel(), v.ravel()], axis=1)


def intrinsics(focal_px):
    return np.array([[focal_px, 0.0, WIDTH / 2], [0.0, focal_px, HEIGHT / 2], [0.0, 0.0, 1.0]])


def radius_drawn(radius, k):
    """Radius in the picture of a ray of this slope, in focal lengths (Brown's model, radial part)."""
    return radius * (1.0 + k[0] * radius**2 + k[1] * radius**4 + k[4] * radius**6)


@pytest.mark.parametrize("focal_px", [50, 60, 75])
def test_every_pixel_of_a_wide_lens_has_its_ray(focal_px):
    slopes = ray_slopes(pixels(), intrinsics(focal_px), WIDE)
    radius = np.linalg.norm(slopes, axis=1)
    away = np.linalg.norm(pixels() - [WIDTH / 2, HEIGHT / 2], axis=1) / focal_px
    assert radius_drawn(radius, WIDE) == pytest.approx(away, abs=1e-4)
    plain = cv2.undistortPoints(pixels()[:, None], intrinsics(focal_px), np.array(WIDE)).reshape(-1, 2)
    assert np.abs(plain - slopes).max() > 0.02  # OpenCV's own steps end too early


def test_a_pixel_beyond_the_fold_has_no_ray():
    focal_px = 70.0
    slopes = ray_slopes(pixels(), intrinsics(focal_px), FOLDING)
    reached = radius_drawn(np.linspace(0.0, 2.0, 20001), FOLDING)
    fold = reached[: np.argmax(np.diff(reached) < 0.0)].max()
    away = np.linalg.norm(pixels() - [WIDTH / 2, HEIGHT / 2], axis=1) / focal_px
    assert np.isfinite(slopes[away < fold - 0.01]).all()
    assert np.isnan(slopes[away > fold + 0.01]).all()
    assert 0.02 < (away > fold + 0.01).mean() < 0.6


def test_an_ideal_lens_is_a_pinhole():
    slopes = ray_slopes(pixels(), intrinsics(80.0), (0.0,) * 5)
    assert slopes == pytest.approx((pixels() - [WIDTH / 2, HEIGHT / 2]) / 80.0, abs=1e-9)
