"""Known gains are applied as a camera would, and figures of the two kinds are kept apart."""

import numpy as np

from advnerf_core.data.views import ImageSet
from advnerf_core.geometry import Pinhole
from benchmarks.exposure import exposed, known_gains


def test_known_gains_are_the_same_in_every_run_and_have_mean_zero() -> None:
    logs = known_gains(400, 0.2)
    np.testing.assert_array_equal(logs, known_gains(400, 0.2))
    np.testing.assert_allclose(logs.mean(axis=0), 0.0, atol=1e-12)
    assert 0.18 < logs.std() < 0.22
    assert not known_gains(5, 0.0).any()


def test_pictures_are_stored_as_a_camera_would() -> None:
    grey = np.full((2, 3, 4, 3), 200, np.uint8)
    images = ImageSet(grey, (Pinhole(4, 3, 4.0, 4.0, 2.0, 1.5),) * 2, np.tile(np.eye(4), (2, 1, 1)))
    bright = exposed(images, np.log([[0.5, 1.0, 1.2], [1.5, 1.0, 1.0]])).rgb
    np.testing.assert_array_equal(bright[0, 0, 0], [100, 200, 240])
    np.testing.assert_array_equal(bright[1, 0, 0], [255, 200, 200])
