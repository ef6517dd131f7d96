"""A camera of known numbers is found again within what its noise allows; sets that fix none are refused with the reason."""

from dataclasses import replace

import numpy as np
import pytest

from advnerf_core.errors import ConfigError
from calibration import intrinsics
from calibration.charuco import Board, BoardDetector
from calibration.degeneracy import DegenerateDataError, PoorFitError
from calibration.intrinsics import calibrate_intrinsics, distinct, pixel_shape_warning
from calibration.measured import LensCalibration
from calibration.schema import CalibrationError, load_calibration, save_calibration
from tests.support.boards import BOARD, board_views

SIZE = (672, 376)
MATRIX = np.array([[350.0, 0.0, 338.2], [0.0, 351.5, 187.1], [0.0, 0.0, 1.0]])
DISTORTION = (-0.17, 0.03, 0.0006, -0.0004, 0.0)


@pytest.fixture(scope="module")
def views():
    return board_views(np.random.default_rng(1), 30, MATRIX, DISTORTION, SIZE)


def test_known_camera_is_found_within_its_own_standard_deviations(views):
    fit = calibrate_intrinsics(views, SIZE)
    found, stated = fit.calibration, fit.calibration.residuals
    truth = {"fx": 350.0, "fy": 351.5, "cx": 338.2, "cy": 187.1}
    for name, value in truth.items():
        assert abs(getattr(found, name) - value) < 4.0 * stated[f"{name}_stddev_px"], name
        assert stated[f"{name}_stddev_px"] < 0.5
    assert found.distortion[:2] == pytest.approx(DISTORTION[:2], abs=0.02)
    # Two-dimensional noise of 0.1 px each.
    assert found.rms_px == pytest.approx(0.1 * np.sqrt(2.0), rel=0.1)
    assert found.views == 30
    assert fit.used.all()


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_that_few_tilted_pictures_fix_is_found(seed):
    """A slow fit: after OpenCV's 30 steps, the focal length is up to a fifth from the truth and the reprojection error looks well."""
    rng = np.random.default_rng(seed)
    size, matrix = (1280, 720), np.array([[700.0, 0.0, 648.0], [0.0, 700.0, 355.0], [0.0, 0.0, 1.0]])
    flat = board_views(rng, 26, matrix, DISTORTION, size, tilt_rad=0.02)
    tilted = board_views(rng, 5, matrix, DISTORTION, size, tilt_rad=0.02, about_y_rad=0.25)
    found = calibrate_intrinsics([*flat, *tilted], size).calibration
    assert found.fx == pytest.approx(700.0, rel=0.02)
    assert found.rms_px < 0.2


@pytest.mark.parametrize(("stretch", "warned"), [(1.02, "1.019"), (1.0, None)])
def test_a_board_that_was_stretched_along_one_side_is_noticed(stretch, warned):
    """All of its errors go into the ratio of the focal lengths, and the reprojection error looks well."""
    square = np.diag([350.0, 350.0, 1.0]) + np.array([[0, 0, 338.2], [0, 0, 187.1], [0, 0, 0]])
    views = board_views(np.random.default_rng(1), 30, square, DISTORTION, SIZE, noise_px=0.3)
    thought = [replace(each, board_m=each.board_m / [stretch, 1.0, 1.0]) for each in views]
    said = pixel_shape_warning(calibrate_intrinsics(thought, SIZE).calibration)
    assert (f"is {warned}" in said and "stretched" in said) if warned else said == ""


def test_the_pixel_shape_of_a_real_camera_or_an_unsure_fit_is_not_warned_of(views):
    found = calibrate_intrinsics(views, SIZE).calibration  # 0.4 % from square
    assert pixel_shape_warning(found) == ""
    unsure = {**found.residuals, "fx_stddev_px": 5.0}
    wide = found.model_copy(update={"fx": 360.0})
    assert pixel_shape_warning(wide)
    assert pixel_shape_warning(wide.model_copy(update={"residuals": unsure})) == ""


def test_copies_and_a_board_that_stands_still_count_once(views):
    noise = np.random.default_rng(3).normal(0.0, 0.05, (9, *views[0].pixels.shape))
    still = [replace(views[0], pixels=views[0].pixels + each) for each in noise]
    assert distinct([views[0], *still, *views[1:], *views]) == views
    assert len(distinct(views)) == len(views)


def test_a_blurred_view_is_left_out(views):
    rng = np.random.default_rng(2)
    spoiled = list(views)
    spoiled[4] = type(views[4])(
        views[4].board_m, views[4].pixels + rng.normal(0.0, 3.0, views[4].pixels.shape)
    )
    fit = calibrate_intrinsics(spoiled, SIZE)
    assert np.flatnonzero(~fit.used).tolist() == [4]
    assert fit.calibration.fx == pytest.approx(350.0, abs=1.0)


def test_too_few_views_are_refused(views):
    with pytest.raises(DegenerateDataError, match="at least 20 pictures with the board, got 19: take more"):
        calibrate_intrinsics(views[:19], SIZE)


def test_a_board_always_in_one_corner_is_refused(views, monkeypatch):
    monkeypatch.setattr(intrinsics, "MIN_VIEWS", 8)
    half = [type(v)(v.board_m[v.pixels[:, 0] < 330], v.pixels[v.pixels[:, 0] < 330]) for v in views]
    with pytest.raises(DegenerateDataError, match="at the right edge"):
        calibrate_intrinsics([v for v in half if len(v.pixels) >= 6][:25], SIZE)


def test_a_board_seen_face_on_only_is_refused():
    flat = board_views(np.random.default_rng(3), 25, MATRIX, DISTORTION, SIZE, tilt_rad=0.02)
    with pytest.raises(DegenerateDataError, match="face on, focal length and distance cannot be told apart"):
        calibrate_intrinsics(flat, SIZE)


def test_a_blurred_set_is_refused():
    rough = board_views(np.random.default_rng(4), 25, MATRIX, DISTORTION, SIZE, noise_px=1.0)
    with pytest.raises(PoorFitError, match=r"below 0\.5 px, got 1\.\d+ px"):
        calibrate_intrinsics(rough, SIZE)


def test_a_drawn_board_is_detected_at_our_pixel_centres():
    picture = np.pad(BOARD.picture(40), 40, constant_values=255)
    found = BoardDetector(BOARD).find(np.repeat(picture[..., None], 3, axis=-1))
    # Corner k of a picture of 40 px squares lies on the border between two pixels: a whole number where centres are at +0.5.
    np.testing.assert_allclose(found.pixels, 40.0 + found.board_m[:, :2] / BOARD.square_m * 40.0, atol=0.06)
    assert len(found.pixels) == 35
    assert BoardDetector(BOARD).find(np.full((200, 200), 255, np.uint8)) is None


def test_impossible_boards_are_refused():
    with pytest.raises(CalibrationError, match="markers smaller than squares"):
        Board(marker_m=0.2)
    with pytest.raises(CalibrationError, match=r"squares of at most 1 m, got 125 m; is it in mm\?"):
        Board(square_m=125.0, marker_m=94.0)
    with pytest.raises(CalibrationError, match="DICT_4X4_50 has 50"):
        Board(columns=20, rows=20)
    for dictionary in ("DICT_NONE", "ArucoDetector", "4X4_50"):
        with pytest.raises(ConfigError, match="marker dictionary such as"):
            Board(dictionary=dictionary)


def test_the_file_survives_a_round_trip(views, tmp_path):
    calibration = calibrate_intrinsics(views, SIZE).calibration
    save_calibration(calibration, tmp_path / "lens.yaml")
    assert load_calibration(LensCalibration, tmp_path / "lens.yaml") == calibration
