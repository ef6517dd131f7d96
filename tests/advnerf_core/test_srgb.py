import numpy as np
import pytest

from advnerf_core.srgb import to_display, to_linear


def test_the_curve_of_the_standard_both_ways_and_in_the_precision_of_the_light():
    # The two branches meet at 0.04045.
    assert to_linear([0.0, 0.04045, 0.5, 1.0]) == pytest.approx([0.0, 0.0031308, 0.2140411, 1.0], abs=1e-7)
    display = np.linspace(0.0, 1.0, 1001)
    np.testing.assert_allclose(to_display(to_linear(display)), display, atol=1e-7)
    assert to_display(np.zeros(3, np.float32)).dtype == np.float32
