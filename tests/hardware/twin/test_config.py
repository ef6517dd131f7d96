"""The lab's numbers, against the published ones."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from hardware.worlds.lab.config import CameraConfig, LabConfig, TrackConfig


def test_driving_camera_has_the_documented_intrinsics():
    pinhole = LabConfig().camera.pinhole
    assert (pinhole.width, pinhole.height) == (336, 188)
    assert pinhole.fx == pinhole.fy == pytest.approx(173.97, abs=0.01)
    assert (pinhole.cx, pinhole.cy) == (168.0, 94.0)


def test_wider_image_keeps_the_field_of_view():
    pinhole = CameraConfig(width=366).pinhole
    assert 2.0 * math.degrees(math.atan(0.5 * 366 / pinhole.fx)) == pytest.approx(88.0)


def test_camera_looks_forward_and_down():
    T = LabConfig().camera.T_car_from_camera
    np.testing.assert_allclose(T[:3, 3], [0.30, 0.0, 0.20])
    np.testing.assert_allclose(
        T[:3, 2], [math.cos(math.radians(10)), 0.0, -math.sin(math.radians(10))], atol=1e-12
    )
    np.testing.assert_allclose(T[:3, 0], [0.0, -1.0, 0.0], atol=1e-12)


def test_board_faces_the_start_of_the_bottom_straight():
    T = LabConfig().board.T_world_from_face
    normal = T[:3, 0]
    assert math.degrees(math.acos(-normal[0])) == pytest.approx(8.0)
    assert normal[1] < 0.0  # the start of the straight is at y = -2, the board's centre at -1.80
    np.testing.assert_allclose(T[:3, 2], [0.0, 0.0, 1.0], atol=1e-12)


def test_servo_mapping_is_nominal_and_clipped():
    car = LabConfig().car
    assert car.servo_from_steering(0.0) == pytest.approx(0.5304)
    assert car.servo_from_steering(0.1) == pytest.approx(0.5304 - 0.12135)
    assert car.servo_from_steering(1.0) == 0.15
    assert car.servo_from_steering(-1.0) == 0.85
    assert car.erpm_from_speed(1.0) == 4614.0


def test_gain_errors_are_two_to_three_percent():
    car = LabConfig().car
    assert 0.02 <= abs(car.true_servo_gain / car.nominal_servo_gain - 1.0) <= 0.03
    assert 0.02 - 1e-9 <= abs(car.true_erpm_gain / car.nominal_erpm_gain - 1.0) <= 0.03


def test_wrong_keys_and_values_are_errors():
    with pytest.raises(ValidationError, match="widht"):
        LabConfig.model_validate({"camera": {"widht": 366}})
    with pytest.raises(ValidationError, match="corner_radius_m <= side_m / 2"):
        TrackConfig(corner_radius_m=3.0)
    with pytest.raises(ValidationError, match="frozen"):
        LabConfig().shadows = False


def test_config_survives_a_round_trip():
    config = LabConfig(camera=CameraConfig(width=366))
    assert LabConfig.model_validate_json(config.model_dump_json()) == config


def test_a_panel_that_is_moved_keeps_what_was_not_said():
    lab = LabConfig.model_validate({"board": {"x_m": 2.8}, "monitor": {"yaw_rad": 1.0}})
    assert lab.board == LabConfig().board.model_copy(update={"x_m": 2.8})
    assert lab.monitor == LabConfig().monitor.model_copy(update={"yaw_rad": 1.0})
    with pytest.raises(ValidationError, match="x_mm"):
        LabConfig.model_validate({"board": {"x_mm": 2.8}})
