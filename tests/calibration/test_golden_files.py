"""The files as they are on disk: the same text in, the same text out, and old files without the newer keys still load."""

from pathlib import Path

import pytest

from calibration.display_colour import DisplayCalibration
from calibration.measured import LensCalibration, TimeOffsetCalibration
from calibration.schema import (
    CalibrationError,
    CameraCalibration,
    VehicleCalibration,
    load_calibration,
    save_calibration,
)

SHIPPED = Path(__file__).parents[2] / "calibration" / "twin"
GOLDEN = {
    LensCalibration: """\
kind: lens
date: 2026-11-21
method: ChArUco board, two-radial distortion
notes: ''
views: 31
residuals: {rms_px: 0.183, coverage: 0.92}
width: 672
height: 376
fx: 350.25
fy: 351.5
cx: 338.0
cy: 187.0
distortion: [-0.17, 0.03, 0.0, 0.0, 0.0]
rms_px: 0.183
""",
    TimeOffsetCalibration: """\
kind: time_offset
date: 2026-11-21
method: image yaw
notes: ''
views: 190
residuals: {rms_rad: 0.0021}
camera_minus_mocap_s: 0.0671
stddev_s: 0.0004
""",
    VehicleCalibration: """\
kind: vehicle
date: 2026-11-21
method: circles
notes: ''
views: 14
residuals: {steering_rms_rad: 0.0011}
wheelbase_m: 0.25
gains: {erpm_per_mps: 4706.3, erpm_offset: 0.0, servo_per_rad: -1.2438, servo_offset: 0.5334, servo_min: 0.15, servo_max: 0.85}
limits: {speed_min_mps: -0.87, speed_max_mps: 1.3, steering_min_rad: -0.2634, steering_max_rad: 0.3135, acceleration_mps2: 3.5,
  steering_rate_radps: 3.2, current_max_a: 60.0}
response: {pipeline_delay_s: 0.04, steering_delay_s: 0.03, steering_lag_s: 0.06, steering_slew_radps: 3.2, speed_delay_s: 0.03,
  speed_lag_s: 0.15}
""",
    DisplayCalibration: """\
kind: display
date: 2026-11-21
method: camera in the loop
notes: ''
views: 93
residuals: {held_out_rmse: 0.004}
model:
  curves:
  - [0.0, 0.2, 1.0]
  - [0.0, 0.25, 1.0]
  - [0.0, 0.3, 1.0]
  mixing:
  - [0.7, 0.1, 0.0]
  - [0.1, 0.8, 0.1]
  - [0.0, 0.1, 0.7]
  ambient: [0.01, 0.01, 0.02]
  response: 2.2
  falloff: 1.4
conditions: lamps on
""",
}  # fmt: skip


@pytest.mark.parametrize("model", list(GOLDEN))
def test_the_same_text_comes_out(model, tmp_path):
    (tmp_path / "in.yaml").write_text(GOLDEN[model])
    save_calibration(load_calibration(model, tmp_path / "in.yaml"), tmp_path / "out.yaml")
    assert (tmp_path / "out.yaml").read_text() == GOLDEN[model]


def test_files_that_measured_nothing_stay_as_short_as_they_were(tmp_path):
    for model, name in ((CameraCalibration, "camera.yaml"), (VehicleCalibration, "vehicle.yaml")):
        loaded = load_calibration(model, SHIPPED / name)
        assert loaded.views is None
        assert loaded.residuals == {}
        save_calibration(loaded, tmp_path / name)
        text = (tmp_path / name).read_text()
        assert "views" not in text
        assert "residuals" not in text
        assert "response" not in text
        assert load_calibration(model, tmp_path / name) == loaded


@pytest.mark.parametrize(
    ("model", "old", "new", "words"),
    [
        (TimeOffsetCalibration, "stddev_s: 0.0004", "stddev_s: -0.1", "stddev_s"),
        (VehicleCalibration, "steering_lag_s: 0.06", "steering_lag_s: .nan", "steering_lag_s"),
        (
            LensCalibration,
            "views: 31",
            "vues: 31",
            "valid keys here: .*kind",
        ),
        (DisplayCalibration, "[0.0, 0.3, 1.0]", "[0.0, 0.3, 0.9]", "rise from 0 to 1"),
    ],
)
def test_damaged_files_are_refused_with_the_key(model, old, new, words, tmp_path):
    assert old in GOLDEN[model]
    (tmp_path / "bad.yaml").write_text(GOLDEN[model].replace(old, new))
    with pytest.raises(CalibrationError, match=words):
        load_calibration(model, tmp_path / "bad.yaml")
