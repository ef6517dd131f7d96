import numpy as np
import pytest

from advnerf_core.data.lens import Lens
from advnerf_core.geometry import Pinhole
from calibration.lens_choice import nonsense


def camera(f=1300.0, fy=None, k=(0.0, 0.0), width=1200, height=800):
    return Pinhole(width, height, f, fy or f, 0.5 * width, 0.5 * height), Lens((*k, 0.0, 0.0, 0.0))


def test_lenses_that_exist_are_accepted():
    assert nonsense(*camera()) is None
    assert nonsense(*camera(f=700.0, k=(-0.2, 0.05))) is None, "a wide camera of a phone"
    assert nonsense(*camera(f=8000.0, k=(1.5, 0.0))) is None, (
        "far from the axis in focal lengths is what counts"
    )


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (camera(f=48011.0), "of the longer side"),
        (camera(f=300.0), "of the longer side"),
        (camera(fy=1600.0), "differ by more than"),
        (camera(k=(0.0, -1.6e8)), "moves the corners"),
        (camera(f=700.0, k=(-0.33, 0.0)), "folds the border over itself"),
    ],
)
def test_lenses_that_do_not_exist_are_refused_with_the_reason(bad, words):
    assert words in nonsense(*bad)


def test_what_is_accepted_can_be_learned_from():
    """A lens that passes must never be refused later, when its images are undistorted."""
    from advnerf_core.data.lens import straightening

    rng, accepted = np.random.default_rng(0), 0
    for _ in range(150):
        candidate = camera(
            f=rng.uniform(500.0, 3000.0) / 4, k=tuple(rng.uniform(-0.6, 0.6, 2)), width=300, height=200
        )
        if nonsense(*candidate) is None:
            straightening(*candidate)
            accepted += 1
    assert 20 < accepted < 150
