"""The ZED without its SDK: calibration file, rectification, registers, and the whole camera on an emulated device."""

import time

import cv2
import numpy as np
import pytest

from advnerf_core.geometry import Pinhole
from hardware.cameras.zed.calibration import (
    EyeCalibration,
    Rectifier,
    ZedCalibrationError,
    load_factory_calibration,
)
from hardware.cameras.zed.driver import ZedCamera, ZedSource
from hardware.cameras.zed.exposure import (
    ExtensionUnit,
    ZedExposure,
    automatic_is_on,
    exposure_lines,
    lock_exposure,
    read_exposure_lines,
    read_gain,
)
from hardware.errors import HardwareError, ProtocolError
from tests.support.v4l2_device import VideoDevice
from tests.support.v4l2_emulator import VideoPortEmulator
from tests.support.zed_emulator import ZedRegisters

pytestmark = pytest.mark.live

PATH = "/dev/v4l/by-id/usb-Technologies__Inc._ZED-video-index0"


def zed_device(registers=None, **options):
    sizes = [(2560, 720), (1344, 376), (3840, 1080), (4416, 1242)]
    return VideoDevice(
        formats={"YUYV": sizes},
        rates=(30.0, 15.0, 60.0, 100.0),
        controls={},
        extension=registers or ZedRegisters(),
        **options,
    )


def test_factory_file(zed_conf):
    left = load_factory_calibration(zed_conf)
    assert (left.pinhole.width, left.pinhole.height) == (672, 376)
    assert (left.pinhole.fx, left.pinhole.cx, left.pinhole.cy) == (350.1, 335.1, 186.7)
    assert left.distortion == (-0.1737, 0.0276, 0.0003, -0.0002, 0.0011)
    assert load_factory_calibration(zed_conf, "2K").distortion == (0.0,) * 5


def test_case_of_sections_and_a_byte_order_mark_do_not_matter(zed_conf):
    text = zed_conf.read_text().replace("[LEFT_CAM_VGA]", "[left_cam_vga]").replace("fx=", "FX = ")
    zed_conf.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert load_factory_calibration(zed_conf).pinhole.fx == 350.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: "<html>Not found</html>", "expected a ZED calibration file"),
        (
            lambda text: text.replace("LEFT_CAM_VGA", "LEFT"),
            r"expected a section \[LEFT_CAM_VGA\].*calib.stereolabs.com",
        ),
        (lambda text: text.replace("fx=350.1\n", ""), "has no fx"),
        (lambda text: text.replace("350.1", "three"), "could not convert"),
        (lambda text: text.replace("350.1", "nan"), "do not fit 672 x 376"),
        (lambda text: text.replace("cx=334.6", "cx=33.46"), "do not fit 672 x 376"),
    ],
)
def test_bad_factory_files(zed_conf, change, message):
    zed_conf.write_text(change(zed_conf.read_text()))
    with pytest.raises(ZedCalibrationError, match=message):
        load_factory_calibration(zed_conf)


def test_missing_factory_file_says_where_to_get_it(tmp_path):
    with pytest.raises(ZedCalibrationError, match=r"https://calib.stereolabs.com/\?SN="):
        load_factory_calibration(tmp_path / "SN1.conf")


def test_camera_without_distortion_is_only_scaled():
    """Focal length halves and the principal point follows cx' = (cx + 0.5) / 2 - 0.5 of OpenCV's convention."""
    source = Pinhole(672, 376, 350.0, 350.0, 336.0, 188.0)
    rectifier = Rectifier(EyeCalibration(source, (0.0,) * 5), (336, 188))
    assert rectifier.pinhole.fx == pytest.approx(
        175.0, rel=4e-3
    )  # OpenCV fits it to the grid of pixel centres
    assert rectifier.pinhole.cx == pytest.approx(168.0, abs=0.5)
    flat = np.full((376, 672, 3), (10, 120, 250), np.uint8)
    assert (rectifier(flat) == flat[:188, :336]).all()


def test_points_land_where_the_new_pinhole_says(zed_conf):
    """A dot drawn where the distorted camera sees a point appears where the ideal camera sees it."""
    eye = load_factory_calibration(zed_conf)
    rectifier = Rectifier(eye, (336, 188))
    K = eye.pinhole.matrix
    K[:2, 2] -= 0.5
    for point in ([0.0, 0.0, 2.0], [-0.9, 0.4, 2.0], [1.1, -0.5, 2.0], [1.2, 0.6, 2.0]):
        seen, _ = cv2.projectPoints(np.array([point]), np.zeros(3), np.zeros(3), K, np.array(eye.distortion))
        rows, columns = np.mgrid[0:376, 0:672]
        blob = np.exp(-((columns - seen[0, 0, 0]) ** 2 + (rows - seen[0, 0, 1]) ** 2) / (2 * 4.0**2))
        picture = np.repeat(np.round(255 * blob).astype(np.uint8)[:, :, None], 3, axis=2)
        result = rectifier(picture)[:, :, 0].astype(float)
        rows, columns = np.mgrid[0:188, 0:336]
        centre = np.array([(result * columns).sum(), (result * rows).sum()]) / result.sum() + 0.5
        assert np.abs(centre - rectifier.pinhole.project(point)).max() < 0.15


def test_no_black_corners(zed_conf):
    rectifier = Rectifier(load_factory_calibration(zed_conf), (672, 376))
    assert rectifier(np.full((376, 672, 3), 200, np.uint8)).min() == 200


def test_rectifier_does_not_enlarge(zed_conf):
    with pytest.raises(ValueError, match="at most 672 x 376, got 1344 x 376"):
        Rectifier(load_factory_calibration(zed_conf), (1344, 376))


# Registers


def unit_of(registers):
    port = VideoPortEmulator({PATH: zed_device(registers)})
    return ExtensionUnit(port, port.open(PATH), PATH, sleep=lambda s: None)


@pytest.mark.parametrize("length", [384, 64])
def test_exposure_is_locked_on_both_eyes(length):
    registers = ZedRegisters(length)
    unit = unit_of(registers)
    assert automatic_is_on(unit)
    lock_exposure(unit, ZedExposure(50.0, gain_raw=0x0201), fps=30.0)
    assert registers.processor == {0x80181033: 0xB1, 0x80181833: 0xB1}  # only the one bit changed
    for eye in (0, 1):
        # 550 lines in sixteenths: 0x2260 over three bytes.
        assert [registers.sensors[eye][a] for a in (0x3500, 0x3501, 0x3502)] == [0x00, 0x22, 0x60]
        assert [registers.sensors[eye][a] for a in (0x3507, 0x3508, 0x3509)] == [0x00, 0x02, 0x01]
        assert not automatic_is_on(unit, eye)
        assert read_exposure_lines(unit, eye) == 550
        assert read_gain(unit, eye) == 0x0201


def test_messages_byte_by_byte():
    registers = ZedRegisters(64)
    unit = unit_of(registers)
    unit.write_processor(0x80181033, 0xB1)
    unit.write_sensor(1, 0x3501, 0x22)
    golden = [
        "50a20004018018103300010001000000b1",
        "51a2000401801810330001000100000000",
        "50a56c0201000035019001000100000022",
        "51a56c0201000035019001000100000000",
    ]
    assert [message[:17].hex() for message in registers.messages] == golden
    assert not any(any(message[17:]) for message in registers.messages)


def test_register_that_does_not_take_its_value():
    registers = ZedRegisters()
    registers.stuck = {0x80181833}
    with pytest.raises(ProtocolError, match=r"expected register 0x80181833 .* to hold 0xb1, got 0xb3"):
        lock_exposure(unit_of(registers), ZedExposure(50.0), fps=30.0)


def test_nothing_is_written_when_nothing_is_to_be_fixed():
    registers = ZedRegisters()
    lock_exposure(unit_of(registers), ZedExposure(), fps=30.0)
    assert registers.messages == []


def test_other_cameras_are_told_apart():
    with pytest.raises(ProtocolError, match=r"64 or 384 bytes .*got 32; is it a ZED"):
        unit_of(ZedRegisters(32))
    port = VideoPortEmulator({PATH: VideoDevice()})
    with pytest.raises(HardwareError, match="no extension unit 4, so it is not a ZED"):
        ExtensionUnit(port, port.open(PATH), PATH)


@pytest.mark.parametrize(
    ("percent", "fps", "lines"), [(100, 15, 1550), (50, 30, 550), (100, 100, 720), (0.01, 60, 2)]
)
def test_exposure_in_lines(percent, fps, lines):
    assert exposure_lines(percent, fps) == lines


def test_impossible_settings(zed_conf):
    for wrong in (
        {"exposure_percent": 0.0},
        {"exposure_percent": 101.0},
        {"exposure_percent": 5.0, "gain_raw": -1},
        {"gain_raw": 3},
    ):
        with pytest.raises(ValueError, match="expected"):
            ZedExposure(**wrong)
    with pytest.raises(ValueError, match="expected a rate of 15, 30, 60, 100 Hz, got 10"):
        ZedSource(device=PATH, factory=zed_conf, fps=10.0)


# The whole camera


def side_by_side():
    """Left eye reddish with a bright square, right eye blue, as YUYV bytes."""
    y = np.full((376, 1344), 60, np.uint8)
    y[150:226, 300:372] = 200
    chroma = np.full((376, 1344), 128, np.uint8)
    chroma[:, 1:672:2], chroma[:, 672::2] = 180, 220  # V of the left eye, U of the right one
    return np.stack([y, chroma], axis=2).tobytes()


def test_left_eye_rectified_at_ten_hertz_with_exposure_fixed(zed_conf):
    registers = ZedRegisters()
    video = zed_device(registers)
    settings = ZedSource(device=PATH, factory=zed_conf, exposure_percent=40.0)
    camera = ZedCamera(settings, VideoPortEmulator({PATH: video}))
    camera.open()
    assert read_exposure_lines(unit_of(registers)) == 440
    assert (video.width, video.height, video.rate) == (1344, 376, 30.0)
    start, data, frames = time.monotonic_ns() - 700_000_000, side_by_side(), []
    for k in range(19):
        video.expose(data, start + round(k * 1e9 / 30))
        if (frame := camera.read(0.0)) is not None:
            frames.append(frame)
    # The first frame after the start is thrown away, so the grid begins with the second.
    assert [round((f.stamp_mono_ns - start) / 1e6) for f in frames] == [33, 133, 233, 333, 433, 533]
    assert [f.sequence for f in frames] == list(range(6))
    rgb = frames[-1].rgb
    assert (rgb.shape, rgb.dtype) == ((188, 336, 3), np.uint8)
    red, green, blue = rgb.reshape(-1, 3).astype(float).mean(axis=0)
    assert red > green + 30
    assert red > blue + 30
    assert rgb[94, 168].mean() > rgb[20, 20].mean() + 60
    assert camera.pinhole.width == 336
    camera.close()
    camera.close()


def test_device_that_falls_back_to_another_mode_is_refused(zed_conf):
    video = VideoDevice(formats={"YUYV": [(2560, 720)]}, rates=(30.0,), extension=ZedRegisters())
    camera = ZedCamera(ZedSource(device=PATH, factory=zed_conf), VideoPortEmulator({PATH: video}))
    with pytest.raises(ProtocolError, match=r"expected 1344 x 376 YUYV .*got 2560 x 720"):
        camera.open()
