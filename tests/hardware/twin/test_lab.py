"""The synchronous lab: determinism, actuator delay, nominal gains, and driving a lap."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from advnerf_core.geometry import invert_transform, make_transform, planar_pose, rotation_z
from hardware.worlds.lab.config import CameraConfig, CarConfig, LabConfig
from hardware.worlds.lab.lab import Lab
from hardware.worlds.lab.phone import track_length, track_pose
from hardware.worlds.lab.world import shading
from hardware.worlds.world import Panel


@pytest.fixture(scope="module")
def lab():
    with Lab() as lab:
        yield lab


def test_observation_has_the_documented_form(lab):
    lab.reset(*lab.config.start_pose)
    rgb, depth = lab.observe()
    assert rgb.shape == (188, 336, 3)
    assert rgb.dtype == np.uint8
    assert depth.shape == (188, 336)
    assert depth.dtype == np.float32
    assert np.isfinite(depth).all()
    assert lab.observe(depth=False)[1] is None


def test_two_labs_of_one_configuration_agree_to_the_byte(lab):
    pose = (-1.1, -2.05, 0.1)
    lab.reset(*pose)
    with Lab(lab.config) as other:
        other.reset(*pose)
        for _ in range(3):
            assert lab.step(0.1, 0.8, 0.1) == other.step(0.1, 0.8, 0.1)
            for mine, theirs in zip(lab.observe(), other.observe(), strict=True):
                assert mine.tobytes() == theirs.tobytes()
        T = planar_pose(-1.0, -1.0, 0.0) @ lab.config.camera.T_car_from_camera
        assert lab.photograph(T).tobytes() == other.photograph(T).tobytes()


def test_observe_at_equals_driving_there(lab):
    lab.reset(-1.1, -2.0, 0.0)
    lab.step(0.05, 0.8, 0.5)
    state = lab.state
    there, _ = lab.observe(depth=False)
    lab.reset(2.0, 0.0, 1.5)
    elsewhere, _ = lab.observe_at(state.x_m, state.y_m, state.yaw_rad, depth=False)
    np.testing.assert_array_equal(there, elsewhere)
    assert lab.state.x_m == 2.0


def test_a_command_acts_after_the_configured_delay(lab):
    lab.reset(-1.1, -2.0, 0.0)
    assert lab.step(0.0, 0.8, 0.049).x_m == -1.1
    assert lab.step(0.0, 0.8, 0.02).x_m > -1.1
    # A command still under way when the next is sent takes effect in its turn.
    lab.reset(-1.1, -2.0, 0.0, speed_mps=0.8)
    lab.step(0.2, 0.8, 0.04)
    assert lab.step(-0.2, 0.8, 0.04).steering_rad > 0.02


def test_reset_speed_is_held_until_a_command_acts(lab):
    lab.reset(-1.1, -2.0, 0.0, speed_mps=0.8)
    assert lab.step(0.0, 0.8 * 1.02, 0.05).speed_mps == pytest.approx(0.8, rel=1e-9)


def test_commands_go_through_nominal_gains_and_servo_limits(lab):
    car = lab.config.car
    lab.reset(-1.1, -2.0, 0.0)
    state = lab.step(0.2, 0.8, 0.9)
    expected = (
        (car.nominal_servo_gain * 0.2 + car.nominal_servo_offset) - car.true_servo_offset
    ) / car.true_servo_gain
    assert state.steering_rad == pytest.approx(expected, abs=1e-5)
    assert state.speed_mps == pytest.approx(0.8 / 1.02, rel=0.01)
    lab.reset(-1.1, -2.0, 0.0)
    assert lab.step(1.0, 0.8, 0.9).steering_rad == pytest.approx(
        (0.15 - car.true_servo_offset) / car.true_servo_gain, abs=1e-5
    )


def test_crawling_speeds_stop_the_motor(lab):
    lab.reset(-1.1, -2.0, 0.0)
    assert lab.step(0.0, 0.19, 1.0).speed_mps == 0.0  # 0.19 m/s is 877 erpm, below the controller's 900


def test_driving_straight_ends_at_the_board(lab):
    lab.reset(-1.1, -1.75, 0.0)
    for _ in range(80):
        lab.step(0.002, 0.8, 0.1)
    nose = lab.state.x_m + 0.5 * (lab.config.car.wheelbase_m + lab.config.car.body_length_m)
    assert lab.blocked
    assert 2.9 < nose < 3.25


def test_bad_commands_and_poses_are_refused(lab):
    with pytest.raises(ValueError, match="finite command"):
        lab.step(math.nan, 0.8, 0.1)
    with pytest.raises(ValueError, match="free place"):
        lab.reset(0.0, 0.0, 0.0)


def test_overview_shows_the_car_and_the_cameras_do_not(lab):
    lab.reset(-1.1, -2.0, 0.0)
    before, _ = lab.observe(depth=False)
    here = lab.overview(480, 360)[0].astype(int)
    lab.reset(1.1, 2.0, math.pi)
    assert np.abs(lab.overview(480, 360)[0] - here).max() > 50
    lab.reset(-1.1, -2.0, 0.0)
    np.testing.assert_array_equal(lab.observe(depth=False)[0], before)


def test_a_preview_follower_drives_a_lap_on_the_tape(lab):
    """The car can do what the experiments ask: ground-truth steering keeps it near the line for a lap."""
    track, car = lab.config.track, lab.config.car
    lab.reset(*lab.config.start_pose)
    s = track.side_m / 2 - track.corner_radius_m - 2.0 + (track.side_m / 2 - track.corner_radius_m)
    errors = []
    for _ in range(190):
        state = lab.state
        s = min(
            (s + d for d in np.arange(-0.05, 0.25, 0.005)),
            key=lambda u: math.dist(track_pose(track, u)[:2], (state.x_m, state.y_m)),
        )
        x, y, _ = track_pose(track, s + 0.45)
        bearing = math.remainder(math.atan2(y - state.y_m, x - state.x_m) - state.yaw_rad, 2 * math.pi)
        distance = math.hypot(x - state.x_m, y - state.y_m)
        lab.step(math.atan(2.0 * car.wheelbase_m * math.sin(bearing) / distance), 0.8, 0.1)
        errors.append(math.dist(track_pose(track, s)[:2], (state.x_m, state.y_m)))
    assert track_length(track) < 190 * 0.1 * 0.8
    assert max(errors) < 0.2
    assert np.mean(errors) < 0.08


def test_wide_image_and_no_delay_by_config():
    config = LabConfig(camera=CameraConfig(width=366), car=CarConfig(command_delay_s=0.0), shadows=False)
    with Lab(config) as lab:
        lab.reset(-1.1, -2.0, 0.0)
        assert lab.observe()[0].shape == (188, 366, 3)
        assert lab.step(0.0, 0.8, 0.02).x_m > -1.1


def test_a_closed_lab_says_so():
    lab = Lab(LabConfig(shadows=False))
    lab.close()
    lab.close()
    with pytest.raises(RuntimeError, match="closed"):
        lab.observe()


def test_a_panel_in_the_room_is_lit_as_the_furniture_is_and_leaves_no_trace(lab: Lab) -> None:
    pose = (0.0, -1.5, 0.0)
    lab.set_board_image(np.full((4, 4, 3), (200, 20, 20), np.uint8))
    before = lab.observe_at(*pose, depth=False)[0]
    panel = Panel(make_transform(rotation_z(math.pi - 0.3), [1.2, -1.5, 0.2]), 0.3, 0.3)
    grey, other = (np.full((8, 8, 3), value, np.uint8) for value in (120, 40))
    lab.add_panel("p", panel, grey)
    rgb, depth = lab.observe_at(*pose)
    on_it = np.abs(rgb.astype(int) - before).max(axis=2) > 8
    T_camera_from_world = invert_transform(planar_pose(*pose) @ lab.T_car_from_camera)
    middle = (T_camera_from_world @ [1.2, -1.5, 0.2, 1.0])[:3]
    column, row = np.rint(lab.camera_pinhole.project(middle)).astype(int)
    # The closed form of the lights that are on: ambient, and three directions.
    normal = np.array([math.cos(math.pi - 0.3), math.sin(math.pi - 0.3), 0.0])
    assert rgb[row, column] == pytest.approx([120 * min(shading(normal), 1.0)] * 3, abs=2)
    assert shading(normal) < 0.95
    assert depth[row, column] == pytest.approx(middle[2], abs=0.01)
    side_px = 0.3 * lab.camera_pinhole.fx / middle[2]
    assert on_it.sum() == pytest.approx(side_px**2, rel=0.1)
    lab.add_panel("p", panel, other)
    darker = lab.observe_at(*pose, depth=False)[0]
    assert darker[row, column] == pytest.approx(rgb[row, column] / 3.0, abs=2)
    beside = cv2.dilate(on_it.astype(np.uint8), np.ones((5, 5))) == 0
    assert np.array_equal(darker[beside], rgb[beside])
    # What the board shows outlives the panels, and nothing of these stays.
    lab.add_panel("q", replace(panel, width_m=0.2), grey)
    for name in ("p", "q", "q"):
        lab.add_panel(name, panel, None)
    assert np.array_equal(lab.observe_at(*pose, depth=False)[0], before)
    lab.set_board_image(None)
