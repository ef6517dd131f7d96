"""Boxes that nobody gave: of silhouettes, compared with known objects, and around cameras."""

import numpy as np

from advnerf_core.data.views import ImageSet
from advnerf_core.geometry import Pinhole, look_at
from advnerf_core.scene.auto_box import box_around_cameras, box_of_silhouettes

PINHOLE = Pinhole(96, 72, 90.0, 90.0, 48.0, 36.0)
CENTRE, RADII = np.array([4.0, -2.0, 1.0]), np.array([0.5, 0.3, 0.2])


def poses(count=24, distance=2.0):
    rng = np.random.default_rng(0)
    away = rng.normal(size=(count, 3))
    away *= distance / np.linalg.norm(away, axis=1, keepdims=True)
    return np.stack([look_at(CENTRE + each, CENTRE) for each in away])


def ellipsoid(T):
    """Opacity of an ellipsoid, in closed form: a ray meets it where a quadratic has roots."""
    rays = PINHOLE.directions() @ T[:3, :3].T / RADII
    origin = (T[:3, 3] - CENTRE) / RADII
    a, b, c = (rays**2).sum(-1), (rays * origin).sum(-1), (origin**2).sum() - 1.0
    return np.where(b**2 > a * c, 255, 0).astype(np.uint8)


def views(alpha):
    rgb = np.zeros((*alpha.shape, 3), np.uint8)
    return ImageSet(rgb, (PINHOLE,) * len(alpha), poses(len(alpha)), alpha)


def test_the_box_of_silhouettes_is_that_of_the_object():
    low, high = box_of_silhouettes(views(np.stack([ellipsoid(T) for T in poses()])))
    assert (low <= CENTRE - RADII).all()
    assert (high >= CENTRE + RADII).all()
    # The hull of finitely many views is a little larger than the object.
    assert (high - low <= 2.0 * RADII + 0.15).all()


def test_no_silhouettes_no_box():
    assert box_of_silhouettes(views(np.zeros((4, 72, 96), np.uint8))) is None
    opaque = views(np.zeros((4, 72, 96), np.uint8))
    assert box_of_silhouettes(ImageSet(opaque.rgb, opaque.pinholes, opaque.T_world_from_camera)) is None


def test_the_box_around_cameras_holds_them_with_a_margin():
    low, high = box_around_cameras(poses())
    places = poses()[:, :3, 3]
    longest = np.ptp(places, axis=0).max()
    np.testing.assert_allclose(low, places.min(axis=0) - 0.5 * longest)
    np.testing.assert_allclose(high, places.max(axis=0) + 0.5 * longest)


def test_parallel_views_are_no_error():
    parallel = np.stack([look_at([0.3 * k, 0.0, 1.0], [0.3 * k, 5.0, 1.0]) for k in range(4)])
    alpha = np.full((4, 72, 96), 255, np.uint8)
    found = box_of_silhouettes(ImageSet(np.zeros((4, 72, 96, 3), np.uint8), (PINHOLE,) * 4, parallel, alpha))
    assert found is None or np.isfinite(found).all()
