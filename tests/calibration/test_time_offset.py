"""An offset put between camera and motion capture is measured; steady, rhythmic and missing turns are refused with the reason."""

import numpy as np
import pytest

from advnerf_core.geometry import camera_mount
from calibration.degeneracy import DegenerateDataError, PoorFitError
from calibration.measured import TimeOffsetCalibration
from calibration.schema import CameraCalibration, load_calibration, save_calibration
from calibration.time_offset import Turns, fit_offset, image_turns
from tests.support.turning import far_wall, yaw_at

CAMERA = CameraCalibration(
    date="2026-11-21",
    method="test",
    width=336,
    height=188,
    fx=174.0,
    fy=174.0,
    cx=168.0,
    cy=94.0,
    T_car_from_camera=camera_mount(0.3, 0.0, 0.2, 0.17).tolist(),
)
POSE_S = np.arange(0.0, 24.0, 0.01)
FRAME_S = np.arange(1.0, 23.0, 0.1)


def turns(offset_s, rng, noise_rad=0.002, yaw=yaw_at):
    a, b = FRAME_S[:-1], FRAME_S[1:]
    return Turns(a, b, yaw(b - offset_s) - yaw(a - offset_s) + rng.normal(0.0, noise_rad, len(a)))


@pytest.mark.parametrize("offset_s", [0.0, 0.0437, -0.112, 0.25])
def test_known_offset(offset_s):
    rng = np.random.default_rng(0)
    fit = fit_offset(turns(offset_s, rng), POSE_S, yaw_at(POSE_S) + rng.normal(0.0, 0.001, len(POSE_S)))
    assert fit.camera_minus_mocap_s == pytest.approx(offset_s, abs=0.003)
    assert abs(fit.camera_minus_mocap_s - offset_s) < 4.0 * fit.stddev_s
    assert fit.scale == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("offset_s", [0.06, -0.2])
def test_a_car_that_was_hidden_for_two_seconds_costs_only_those_turns(offset_s):
    rng = np.random.default_rng(0)
    kept = (POSE_S < 9.0) | (POSE_S > 11.0)
    yaw = yaw_at(POSE_S) + rng.normal(0.0, 0.001, len(POSE_S))
    fit = fit_offset(turns(offset_s, rng), POSE_S[kept], yaw[kept])
    assert fit.camera_minus_mocap_s == pytest.approx(offset_s, abs=0.003)
    assert 185 < len(fit.turns.yaw_rad) < 195


@pytest.mark.parametrize(("of_camera", "of_car"), [(1.0, np.degrees(1.0)), (2.0, 1.0), (0.5, 1.0)])
def test_a_lens_or_a_unit_that_is_not_theirs_is_refused(of_camera, of_car):
    """Degrees, and a lens of another focal length, fitted as well as the truth does, with another scale."""
    found = turns(0.04, np.random.default_rng(0), yaw=lambda t: of_camera * yaw_at(t))
    with pytest.raises(PoorFitError, match=r"got [\d.]+ times: is the lens") as refused:
        fit_offset(found, POSE_S, of_car * yaw_at(POSE_S))
    got = float(str(refused.value).partition("got ")[2].partition(" times")[0])
    assert got == pytest.approx(of_camera / of_car, rel=0.02)


def test_pictures_of_a_far_wall_turn_as_the_camera_did():
    """A texture at infinity, warped by the known rotation: image turns against the closed form."""
    times = np.arange(0.0, 2.0, 0.1)
    frames = list(zip(times, far_wall(CAMERA, 0.5 * yaw_at(times)), strict=True))
    found = image_turns(frames, CAMERA)
    truth = 0.5 * (yaw_at(found.end_s) - yaw_at(found.start_s))
    assert len(found.yaw_rad) >= 18
    np.testing.assert_allclose(found.yaw_rad, truth, atol=0.002)


def test_a_car_at_rest_is_refused():
    rng = np.random.default_rng(2)
    with pytest.raises(DegenerateDataError, match="too little excitation"):
        fit_offset(turns(0.0, rng, yaw=lambda t: 0.0 * t), POSE_S, 0.0 * POSE_S)


def test_a_steady_circle_is_refused():
    rng = np.random.default_rng(3)
    with pytest.raises(DegenerateDataError, match=r"steady rate .* same at any offset"):
        fit_offset(turns(0.0, rng, yaw=lambda t: 0.5 * t), POSE_S, 0.5 * POSE_S)


def test_a_rhythm_is_refused():
    rng = np.random.default_rng(4)

    def swing(t):
        return 0.3 * np.sin(2.0 * np.pi * t / 0.35)

    with pytest.raises(DegenerateDataError, match=r"not in a rhythm"):
        fit_offset(turns(0.0, rng, yaw=swing), POSE_S, swing(POSE_S))


@pytest.mark.parametrize(("period_s", "offset_s"), [(0.7, 0.6), (1.0, 1.037), (2.0, 0.05)])
def test_a_slow_rhythm_is_refused_as_a_period_more_or_less_looks_alike(period_s, offset_s):
    """Turned to and fro every 0.7 s, an offset of +600 ms was measured as -100 ms, with a correlation of 0.9999."""

    def swing(t):
        return 0.3 * np.sin(2.0 * np.pi * t / period_s) + 0.1 * np.sin(4.0 * np.pi * t / period_s + 1.0)

    with pytest.raises(DegenerateDataError, match=r"turns that repeat after about .* not in a rhythm"):
        fit_offset(turns(offset_s, np.random.default_rng(5), yaw=swing), POSE_S, swing(POSE_S))


def test_another_car_is_refused():
    rng = np.random.default_rng(5)
    with pytest.raises(PoorFitError, match="is the subject the car the camera is on"):
        fit_offset(turns(0.0, rng), POSE_S, 0.6 * np.sin(0.77 * POSE_S) + 0.2 * np.sin(3.3 * POSE_S))


def test_a_short_recording_and_a_black_one_are_refused():
    rng = np.random.default_rng(6)
    few = turns(0.0, rng)
    with pytest.raises(DegenerateDataError, match="at least 40 pairs of frames"):
        fit_offset(Turns(few.start_s[:30], few.end_s[:30], few.yaw_rad[:30]), POSE_S, yaw_at(POSE_S))
    black = image_turns([(0.1 * k, np.zeros((188, 336), np.uint8)) for k in range(3)], CAMERA)
    assert len(black.yaw_rad) == 0
    with pytest.raises(DegenerateDataError, match="frames of 336 x 188, as calibrated, got 10 x 10"):
        image_turns([(0.0, np.zeros((10, 10), np.uint8))], CAMERA)


def test_the_file_survives_a_round_trip(tmp_path):
    found = fit_offset(turns(0.05, np.random.default_rng(7)), POSE_S, yaw_at(POSE_S)).calibration
    save_calibration(found, tmp_path / "offset.yaml")
    assert load_calibration(TimeOffsetCalibration, tmp_path / "offset.yaml") == found
