"""A monitor of another mathematical form than the model is learned to a percent; useless sets are refused with the reason."""

import numpy as np
import pytest

from advnerf_core.display import DisplayModel
from calibration.degeneracy import DegenerateDataError, PoorFitError
from calibration.display_colour import (
    DisplayCalibration,
    colours_to_show,
    fit_display,
    mean_colour,
    screen_region,
)
from calibration.schema import CalibrationError, load_calibration, save_calibration

SHOWN = colours_to_show() / 255.0
MIXING = np.array([[0.60, 0.09, 0.02], [0.06, 0.66, 0.05], [0.01, 0.08, 0.63]])


def monitor(shown, cos_angle=1.0, falloff=0.0, gain=1.0):
    """Curves with a toe, mixed light, glare and a camera of sRGB's form: none of it in the model's own parameters."""
    light = 0.985 * shown ** np.array([2.35, 2.15, 2.5]) + 0.015 * shown
    seen = 0.012 + np.asarray(cos_angle)[..., None] ** falloff * gain * (light @ MIXING.T)
    return np.clip(np.where(seen < 0.0031308, 12.92 * seen, 1.055 * seen ** (1.0 / 2.4) - 0.055), 0.0, 1.0)


def noisy(seen, rng):
    return np.clip(seen + rng.normal(0.0, 0.002, seen.shape), 0.0, 1.0)


@pytest.fixture(scope="module")
def fit():
    return fit_display(SHOWN, noisy(monitor(SHOWN), np.random.default_rng(0)))


def test_held_out_and_new_colours(fit):
    assert fit.rmse(held_out=True) < 0.01
    assert 10 <= fit.held_out.sum() <= 24
    new = np.random.default_rng(1).uniform(0.0, 1.0, (500, 3))
    error = fit.model.forward(new) - monitor(new)
    assert np.sqrt(np.mean(error**2)) < 0.01
    # Taking the monitor for ideal would be far off.
    assert np.sqrt(np.mean((new - monitor(new)) ** 2)) > 0.1


def test_what_the_inverse_shows_is_seen_as_wanted(fit):
    wanted = monitor(np.random.default_rng(2).uniform(0.1, 0.9, (200, 3)))
    shown, clipped = fit.model.inverse(wanted)
    assert clipped == 0.0
    assert np.sqrt(np.mean((monitor(shown) - wanted) ** 2)) < 0.015
    _, all_clipped = fit.model.inverse(np.ones((5, 3)))
    assert all_clipped == 1.0


def test_falloff_is_learned_from_several_angles():
    cos_angle = np.concatenate([np.full(len(SHOWN), c) for c in (1.0, 0.85, 0.6)])
    shown = np.tile(SHOWN, (3, 1))
    seen = noisy(monitor(shown, cos_angle, falloff=1.5), np.random.default_rng(3))
    fit = fit_display(shown, seen, cos_angle)
    assert fit.model.falloff == pytest.approx(1.5, abs=0.15)
    assert fit.rmse(held_out=True) < 0.01


@pytest.mark.parametrize("angle", [45.0, -0.5, 0.0, np.nan])
def test_an_angle_that_is_no_cosine_is_refused(angle):
    shown = np.concatenate([SHOWN, SHOWN])
    seen = noisy(monitor(shown), np.random.default_rng(3))
    with pytest.raises(DegenerateDataError, match=r"cos_angle above 0 and up to 1, .* write its cosine"):
        fit_display(shown, seen, np.concatenate([np.ones(len(SHOWN)), np.full(len(SHOWN), angle)]))


def test_saturated_sets_are_refused():
    with pytest.raises(
        DegenerateDataError, match=r"without a saturated channel, got \d+ %: shorten the exposure"
    ):
        fit_display(SHOWN, monitor(SHOWN, gain=8.0))
    with pytest.raises(DegenerateDataError, match="lengthen the exposure"):
        fit_display(SHOWN, 0.01 * monitor(SHOWN))


def test_pictures_with_red_and_blue_exchanged_are_refused():
    with pytest.raises(PoorFitError, match="got blue as red, red as blue: save the pictures as RGB, not BGR"):
        fit_display(SHOWN, monitor(SHOWN)[:, ::-1])


def test_greys_only_a_drift_too_few_and_another_screen_are_refused():
    rng = np.random.default_rng(4)
    grey = np.repeat(np.linspace(0.0, 1.0, 80)[:, None], 3, axis=1)
    with pytest.raises(DegenerateDataError, match="a line or a plane of them, such as greys only"):
        fit_display(grey, monitor(grey))
    fading = monitor(SHOWN) * np.linspace(1.0, 0.9, len(SHOWN))[:, None]
    with pytest.raises(DegenerateDataError, match="lock exposure and white balance"):
        fit_display(SHOWN, fading)
    with pytest.raises(DegenerateDataError, match="at least 60 colours, got 20"):
        fit_display(SHOWN[:20], monitor(SHOWN[:20]))
    with pytest.raises(DegenerateDataError, match="is this the screen"):
        fit_display(SHOWN, np.full_like(SHOWN, 0.4))
    order = np.concatenate(
        [[0, 1], rng.permutation(np.arange(2, len(SHOWN) - 2)), [len(SHOWN) - 2, len(SHOWN) - 1]]
    )
    with pytest.raises(PoorFitError, match="held-out colours within"):
        fit_display(SHOWN, monitor(SHOWN)[order])


def test_the_sequence_holds_what_the_fit_needs():
    colours = colours_to_show()
    assert colours.dtype == np.uint8
    assert (colours[0] == 0).all()
    assert (colours[-1] == 255).all()
    grey = colours[(colours == colours[:, :1]).all(axis=1), 0]
    assert len(np.unique(grey)) >= 17
    for channel in range(3):
        pure = colours[(np.delete(colours, channel, axis=1) == 0).all(axis=1), channel]
        assert len(np.unique(pure)) >= 8


def test_the_screen_is_found_between_black_and_white():
    black = np.full((100, 160, 3), 30, np.uint8)
    white = black.copy()
    white[20:70, 40:120] = 200
    white[5:8, 5:8] = 200
    region = screen_region(black, white)
    rows, columns = np.nonzero(region)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (22, 67, 42, 117)
    np.testing.assert_allclose(mean_colour([white, black], region), 115.0 / 255.0)
    with pytest.raises(DegenerateDataError, match="is it on, full screen, in view"):
        screen_region(black, black)


def test_the_file_survives_a_round_trip_and_refuses_nonsense(fit, tmp_path):
    calibration = fit.calibration("lamps on")
    save_calibration(calibration, tmp_path / "display.yaml")
    loaded = load_calibration(DisplayCalibration, tmp_path / "display.yaml")
    assert loaded == calibration
    np.testing.assert_allclose(loaded.display.forward(SHOWN), fit.model.forward(SHOWN), atol=1e-5)
    broken = (tmp_path / "display.yaml").read_text().replace("mixing:", "mixed:")
    (tmp_path / "broken.yaml").write_text(broken)
    with pytest.raises(CalibrationError, match="expected curves, mixing, ambient"):
        load_calibration(DisplayCalibration, tmp_path / "broken.yaml")
    assert DisplayModel.ideal().forward([[0.25, 0.5, 0.75]]) == pytest.approx(np.array([[0.25, 0.5, 0.75]]))


@pytest.mark.parametrize("number", [45, 60, 80])
def test_one_picture_of_the_colour_before_is_named(number):
    """The fit spread its error over others: the model was up to 13 of 255 off, and its inverse 26."""
    seen = noisy(monitor(SHOWN), np.random.default_rng(5))
    changed = np.abs(monitor(SHOWN[number]) - monitor(SHOWN[number - 1])).max()
    assert changed > 0.05
    seen[number] = seen[number - 1]
    with pytest.raises(
        PoorFitError, match=rf"got one of colour {number}, counted from 0, that is \d+ % off where the others"
    ):
        fit_display(SHOWN, seen)
