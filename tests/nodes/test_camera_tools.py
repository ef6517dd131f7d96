"""``advnerf car camera``: what it says about emulated devices, and the files it writes."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from advnerf_core.data.errors import DatasetError
from calibration.schema import CameraCalibration, load_calibration
from hardware.cameras.zed.calibration import Rectifier, load_factory_calibration
from nodes.cli.camera import app
from nodes.lab.camera_tools import CameraToolError, describe_devices, parse_source, try_source
from nodes.runtime.errors import ConfigError
from tests.support.v4l2_device import VideoDevice
from tests.support.v4l2_emulator import VideoPortEmulator
from tests.support.zed_emulator import ZedRegisters

pytestmark = pytest.mark.live

TWIN = Path(__file__).parents[2] / "calibration" / "twin" / "camera.yaml"
CONF = "[LEFT_CAM_VGA]\nfx=350\nfy=351\ncx=335\ncy=187\nk1=-0.17\nk2=0.02\n"


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)


@pytest.fixture
def pictures(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for k in range(3):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((188, 336, 3), 100, np.uint8))
    return folder


def test_devices_are_described_with_what_can_be_set():
    zed = VideoDevice(
        formats={"YUYV": [(1344, 376)]}, rates=(30.0,), controls={}, extension=ZedRegisters(), card="ZED"
    )
    webcam = VideoDevice(formats={"YUYV": [(640, 480)], "MJPG": [(1280, 720)]})
    metadata = VideoDevice(metadata_only=True)
    port = VideoPortEmulator({"/dev/a": webcam, "/dev/b": metadata, "/dev/c": zed})
    text = "\n".join(describe_devices(port))
    assert "/dev/a: Emulated Camera (uvcvideo, usb-0000:00:14.0-1)" in text
    assert "    YUYV 640x480@30/15\n    MJPG 1280x720@30/15" in text
    assert "    exposure_absolute: 250  (3 to 2047, step 1)" in text
    assert "gives metadata only" in text
    assert "    YUYV 1344x376@30" in text
    assert "    exposure 0 lines, gain_raw: 384 (automatic)" in text
    assert port.open_files == 0


def test_trial_measures_a_source(pictures, tmp_path):
    out = tmp_path / "last.png"
    result = run("try", f"{{kind: folder, folder: {pictures}, rate_hz: 50}}", "--frames", 12, "-o", out)
    assert result.exit_code == 0
    assert "12 frames of 336 x 188" in result.output
    assert "0 missed" in result.output
    assert "mean brightness 100 of 255" in result.output
    assert cv2.imread(str(out)).shape == (188, 336, 3)
    assert (
        30 < try_source(parse_source(f"{{kind: folder, folder: {pictures}, rate_hz: 50}}"), 12).rate_hz < 52
    )


def test_trial_of_what_is_not_there(tmp_path):
    with pytest.raises(CameraToolError, match=r"expected frames, got 0 in 0.5 s: expected images"):
        try_source(parse_source(f"{{kind: folder, folder: {tmp_path}}}"), timeout_s=0.5)


@pytest.mark.parametrize(
    ("text", "message"), [("{kind", "expected YAML"), ("{kind: v4l2}", "device"), ("{kind: no}", "v4l2")]
)
def test_wrong_source(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_source(text)


def test_picture_format_that_nobody_knows(pictures, tmp_path):
    with pytest.raises(DatasetError, match=r"name of a picture to write .* ends in '.xyz'"):
        run(
            "try",
            f"{{kind: folder, folder: {pictures}, rate_hz: 100}}",
            "--frames",
            2,
            "-o",
            tmp_path / "p.xyz",
        )


def test_factory_file_becomes_a_camera_file(tmp_path):
    (tmp_path / "SN1.conf").write_text(CONF)
    result = run("factory", tmp_path / "SN1.conf", "--mount", TWIN, "-o", tmp_path / "camera.yaml")
    assert result.exit_code == 0
    made = load_calibration(CameraCalibration, tmp_path / "camera.yaml")
    expected = Rectifier(load_factory_calibration(tmp_path / "SN1.conf"), (336, 188)).pinhole
    assert (made.width, made.height, made.distortion) == (336, 188, (0.0,) * 5)
    assert made.fx == pytest.approx(expected.fx, abs=1e-4)
    assert made.T_car_from_camera == load_calibration(CameraCalibration, TWIN).T_car_from_camera
    assert "SN1.conf" in made.method


@pytest.mark.parametrize(
    ("options", "message"),
    [(("--mode", "4K"), "expected --mode 2K"), (("--width", 1344), "at most 672 x 376")],
)
def test_wrong_factory_options(tmp_path, options, message):
    with pytest.raises(CameraToolError, match=message):
        run("factory", tmp_path / "SN1.conf", "--mount", TWIN, "-o", tmp_path / "camera.yaml", *options)
