"""A mounting pose found again from noisy boards and poses; planar, contradictory and short sets refused with the reason."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from advnerf_core.data.similarity import rotation_angles
from advnerf_core.geometry import camera_mount, invert_transform, make_transform, planar_pose
from calibration.camera_to_car import MountView, calibrate_mount
from calibration.charuco import Detection
from calibration.degeneracy import DegenerateDataError, PoorFitError
from calibration.measured import LensCalibration
from calibration.schema import CameraCalibration, load_calibration, save_calibration
from tests.support.boards import seen, turned

LENS = LensCalibration(
    date="2026-11-21",
    method="test",
    width=336,
    height=188,
    fx=174.0,
    fy=174.0,
    cx=168.0,
    cy=94.0,
    rms_px=0.1,
    distortion=(-0.1, 0.01, 0.0, 0.0, 0.0),
)
MOUNT = camera_mount(0.30, 0.01, 0.20, np.radians(10.0), np.radians(1.5))
# The print on the board: its z axis into the board, which is the board's -x.
PATTERN = make_transform(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), [0.002, -0.4, 0.3])


def views(rng, count=30, tilt_rad=0.35, tracked=True, mocap=(0.0005, 0.001), noise_px=0.1):
    """A car on the floor about a metre before a board that is held up to it, tilted by hand."""
    found = []
    while len(found) < count:
        board = planar_pose(0.0, 0.0, 0.0) @ make_transform(
            Rotation.from_euler("xyz", rng.uniform(-tilt_rad, tilt_rad, 3)).as_matrix(), [0.0, 0.0, 0.2]
        )
        if not tracked:
            board = make_transform(np.eye(3), [0.0, 0.0, 0.2])
        angle = rng.uniform(-0.5, 0.5)
        away = rng.uniform(0.8, 1.6)
        place = planar_pose(
            away * np.cos(angle), away * np.sin(angle), angle + np.pi + rng.uniform(-0.3, 0.3)
        )
        if not tracked:
            place = place @ make_transform(
                Rotation.from_euler("xy", rng.uniform(-tilt_rad, tilt_rad, 2)).as_matrix(), [0.0, 0.0, 0.0]
            )
        T = invert_transform(place @ MOUNT) @ board @ PATTERN
        detection = seen(T, LENS.pinhole.matrix, LENS.distortion, (336, 188), rng, noise_px)
        if detection is None or len(detection.pixels) < 15:
            continue
        car = turned(place, rng, mocap[1], mocap[0])
        found.append(MountView(car, turned(board, rng, mocap[1], mocap[0]) if tracked else None, detection))
    return found


def errors(fit):
    turn = float(rotation_angles(fit.T_car_from_camera[:3, :3].T @ MOUNT[:3, :3]))
    return np.degrees(turn), float(np.linalg.norm(fit.T_car_from_camera[:3, 3] - MOUNT[:3, 3]))


def test_tracked_board_with_unknown_pattern_pose():
    fit = calibrate_mount(views(np.random.default_rng(0), 40), LENS)
    degrees, metres = errors(fit)
    assert degrees < 0.1
    assert metres < 0.002
    # The stated standard deviations are of the size of the errors: neither boast nor scare.
    assert 0.3 < metres / fit.translation_stddev_m < 4.0 or metres < 0.0005
    assert fit.translation_stddev_m < 0.002
    np.testing.assert_allclose(fit.T_base_from_pattern, PATTERN, atol=0.004)


def test_without_noise_the_truth_comes_back():
    fit = calibrate_mount(views(np.random.default_rng(1), 20, mocap=(0.0, 0.0), noise_px=1e-4), LENS)
    degrees, metres = errors(fit)
    assert degrees < 1e-3
    assert metres < 1e-5


def test_known_pattern_pose_needs_no_tilt():
    rng = np.random.default_rng(2)
    fit = calibrate_mount(views(rng, 30, tilt_rad=0.0), LENS, PATTERN)
    degrees, metres = errors(fit)
    assert degrees < 0.1
    assert metres < 0.002


def test_planar_views_with_unknown_pattern_pose_are_refused():
    with pytest.raises(DegenerateDataError, match=r"more than one axis, got planar ones: .* tilt the board"):
        calibrate_mount(views(np.random.default_rng(3), 30, tilt_rad=0.0), LENS)


def test_hand_eye_works_for_a_car_tilted_by_hand_and_is_refused_on_the_floor():
    fit = calibrate_mount(views(np.random.default_rng(4), 40, tracked=False), LENS)
    degrees, metres = errors(fit)
    assert degrees < 0.2
    assert metres < 0.004
    assert "hand-eye" in fit.method
    with pytest.raises(DegenerateDataError, match=r"planar ones: .* track the board"):
        calibrate_mount(views(np.random.default_rng(5), 30, tilt_rad=0.0, tracked=False), LENS)


def test_views_in_motion_are_left_out():
    rng = np.random.default_rng(6)
    some = views(rng, 40)
    for row in (3, 11, 27):
        some[row] = MountView(
            turned(some[row].T_world_from_car, rng, 0.1, 0.08), some[row].T_world_from_board, some[row].found
        )
    fit = calibrate_mount(some, LENS)
    assert set(np.flatnonzero(~fit.used)) >= {3, 11, 27}
    assert (~fit.used).sum() <= 5
    assert errors(fit)[1] < 0.002


def test_contradictory_views_are_refused():
    rng = np.random.default_rng(7)
    some = [
        MountView(turned(v.T_world_from_car, rng, 0.3, 0.3), v.T_world_from_board, v.found)
        for v in views(rng)
    ]
    with pytest.raises(PoorFitError, match="agree on one mounting pose"):
        calibrate_mount(some, LENS)


def test_too_few_views_are_refused():
    with pytest.raises(DegenerateDataError, match="at least 10 views with an unambiguous board, got 9"):
        calibrate_mount(views(np.random.default_rng(8), 9), LENS)
    with pytest.raises(DegenerateDataError, match="expected a tracked board"):
        calibrate_mount(views(np.random.default_rng(8), 12, tracked=False), LENS, PATTERN)


def test_the_file_is_a_camera_and_survives_a_round_trip(tmp_path):
    fit = calibrate_mount(views(np.random.default_rng(9), 20), LENS)
    calibration = fit.calibration(LENS)
    save_calibration(calibration, tmp_path / "camera.yaml")
    loaded = load_calibration(CameraCalibration, tmp_path / "camera.yaml")
    assert loaded == calibration
    np.testing.assert_allclose(loaded.mount, fit.T_car_from_camera, atol=1e-9)
    assert loaded.residuals["translation_stddev_m"] > 0.0


@pytest.mark.parametrize("tracked", [True, False])
@pytest.mark.parametrize(
    ("square", "focal", "percent"),
    [(1.02, 1.0, r"2\.\d % smaller|1\.9 % smaller"), (0.98, 1.0, "% larger"), (1.0, 1.05, "% smaller")],
)
def test_a_board_of_another_size_and_a_lens_of_another_length_are_refused(tracked, square, focal, percent):
    """Both had passed: 2 % of the squares moves the camera by 13 mm and more, and the stated standard deviation is below 1 mm."""
    found = views(np.random.default_rng(0), tracked=tracked)
    said = [replace(each, found=Detection(square * each.found.board_m, each.found.pixels)) for each in found]
    lens = LENS.model_copy(update={"fx": focal * LENS.fx, "fy": focal * LENS.fy})
    with pytest.raises(
        PoorFitError, match=rf"({percent}) to motion capture: measure --square .* focal length"
    ):
        calibrate_mount(said, lens)


def test_a_subject_that_points_backwards_gives_no_file():
    """All that reads a camera's file would refuse it."""
    back = make_transform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    found = [
        replace(each, T_world_from_car=each.T_world_from_car @ back)
        for each in views(np.random.default_rng(0))
    ]
    with pytest.raises(
        PoorFitError, match=r"looks ahead, upright, .* does the subject's x axis point forward"
    ):
        calibrate_mount(found, LENS).calibration(LENS)
