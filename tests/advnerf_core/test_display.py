"""The display model: closed form, its inverse, and the torch twin with gradients by finite differences."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from advnerf_core.attack.spaces.displayed import DisplayedSensor, displayed
from advnerf_core.display import DisplayModel, DisplayModelError
from advnerf_core.scene.surrogate import Rendered
from tests.support.printers import printed, printer_model

LEVELS = np.linspace(0.0, 1.0, 17)
MODEL = DisplayModel(
    np.stack([LEVELS**2.2, LEVELS**1.8, LEVELS**2.5]),
    np.array([[0.7, 0.1, 0.02], [0.05, 0.8, 0.06], [0.01, 0.1, 0.75]]),
    np.array([0.01, 0.02, 0.015]),
    2.1,
    1.3,
)
PRINTER = printer_model()


def test_at_the_levels_it_is_the_closed_form():
    shown = LEVELS[[3, 8, 15]]
    light = shown ** np.array([2.2, 1.8, 2.5])
    expected = (MODEL.ambient + 0.8**1.3 * MODEL.mixing @ light) ** (1.0 / 2.1)
    np.testing.assert_allclose(MODEL.forward(shown, 0.8), expected, rtol=1e-12)
    np.testing.assert_allclose(MODEL.forward([0.0, 0.0, 0.0]), MODEL.ambient ** (1.0 / 2.1), rtol=1e-12)


def test_with_products_it_is_the_equation_of_three_inks():
    shown = LEVELS[np.random.default_rng(4).integers(0, 17, (100, 3))]
    np.testing.assert_allclose(PRINTER.forward(shown), printed(shown), atol=1e-12)


@pytest.mark.parametrize("model", [MODEL, PRINTER], ids=["monitor", "printer"])
def test_inverse_undoes_forward(model):
    shown = np.random.default_rng(0).uniform(0.0, 1.0, (50, 3))
    back, clipped = model.inverse(model.forward(shown, 0.9), 0.9)
    np.testing.assert_allclose(back, shown, atol=1e-6)
    assert clipped == 0.0
    wanted = np.array([[0.0, 1.0, 0.0], *model.forward(shown[:3])])
    assert model.inverse(wanted)[1] == 0.25


@pytest.mark.parametrize("model", [MODEL, PRINTER], ids=["monitor", "printer"])
def test_the_torch_twin_is_equal(model):
    rng = np.random.default_rng(1)
    shown = np.concatenate([rng.uniform(0.0, 1.0, (200, 3)), np.array([[0.0, 1.0, 0.5], [-0.1, 1.1, 0.0]])])
    cos_angle = rng.uniform(0.3, 1.0, len(shown))
    ours = displayed(model, torch.tensor(shown), torch.tensor(cos_angle)).numpy()
    np.testing.assert_allclose(ours, model.forward(shown, cos_angle), atol=1e-12)
    single = displayed(model, torch.tensor(shown, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(single, model.forward(shown), atol=2e-6)


@pytest.mark.parametrize("model", [MODEL, PRINTER], ids=["monitor", "printer"])
def test_gradients_by_finite_differences(model):
    shown = torch.tensor(np.random.default_rng(2).uniform(0.03, 0.97, (20, 3)), requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: displayed(model, x, 0.7), (shown,), eps=1e-7, atol=1e-5)


@dataclass
class Squashed:
    """A sensor whose image is a fixed linear mixture of the squashed colours."""

    weights: torch.Tensor
    theta_shape: tuple[int, ...] = (4, 3)

    def initial_theta(self, generator):
        return torch.randn(self.theta_shape, generator=generator, dtype=torch.float64)

    def sense(self, states, theta):
        colours = torch.sigmoid(theta)
        images = torch.einsum("bijk,jk->bik", self.weights, colours)
        slope = colours * (1.0 - colours)
        return Rendered(images, lambda g: torch.einsum("bijk,bik->jk", self.weights, g) * slope, 0)


def test_the_displayed_sensor_shows_what_is_seen_and_differentiates_through_it():
    generator = torch.Generator().manual_seed(0)
    inner = Squashed(torch.randn(2, 5, 4, 3, generator=generator, dtype=torch.float64))
    sensor = DisplayedSensor(inner, MODEL, cos_angle=0.9)
    theta = sensor.initial_theta(generator)
    rendered = sensor.sense(torch.zeros(2, 3), theta)
    seen = MODEL.forward(torch.sigmoid(theta).numpy(), 0.9)
    expected = torch.einsum("bijk,jk->bik", inner.weights, torch.tensor(seen))
    torch.testing.assert_close(rendered.images, expected, atol=1e-9, rtol=0.0)
    g = torch.randn(rendered.images.shape, generator=generator, dtype=torch.float64)
    gradient, step = rendered.vjp(g), 1e-6
    for index in [(0, 0), (1, 2), (3, 1)]:
        moved = theta.clone()
        moved[index] += step
        change = ((sensor.sense(torch.zeros(2, 3), moved).images - rendered.images) * g).sum() / step
        assert float(change) == pytest.approx(float(gradient[index]), rel=1e-4, abs=1e-7)
    # The result may be asked for more than once, as when a render is kept.
    torch.testing.assert_close(rendered.vjp(g), gradient)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"curves": np.array([[0.0, 0.6, 0.5, 1.0]] * 3)}, "rise from 0 to 1"),
        ({"mixing": np.ones((3, 3))}, "can be inverted"),
        ({"ambient": np.array([-0.1, 0.0, 0.0])}, "ambient light and falloff >= 0"),
        ({"response": float("nan")}, "finite numbers"),
        ({"mixing": np.ones((2, 3))}, r"mixing \[3, 3\]"),
    ],
)
def test_impossible_displays_are_refused(change, words):
    values = {**{key: np.array(value) for key, value in MODEL.to_dict().items()}, **change}
    with pytest.raises(DisplayModelError, match=words):
        DisplayModel(
            values["curves"],
            values["mixing"],
            values["ambient"],
            float(values["response"]),
            float(values["falloff"]),
        )


def test_round_trip_through_plain_numbers():
    again = DisplayModel.from_dict(MODEL.to_dict())
    np.testing.assert_array_equal(
        again.forward(LEVELS[:, None].repeat(3, 1)), MODEL.forward(LEVELS[:, None].repeat(3, 1))
    )
    with pytest.raises(DisplayModelError, match="expected curves, mixing, ambient"):
        DisplayModel.from_dict({"curves": [[0, 1]] * 3})
