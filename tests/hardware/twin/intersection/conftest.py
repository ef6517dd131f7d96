"""One intersection for all tests of this folder: it takes seconds to paint."""

import pytest

from hardware.worlds.junction.scene import Intersection


@pytest.fixture(scope="session")
def intersection():
    with Intersection() as scene:
        yield scene
