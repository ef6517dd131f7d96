"""The V4L2 driver against a device that answers the kernel's requests byte by byte."""

import ctypes
import fcntl
import os
import pty
import struct
import termios
import time

import cv2
import numpy as np
import pytest

from hardware.cameras.v4l2 import abi
from hardware.cameras.v4l2 import controls as v4l2_controls
from hardware.cameras.v4l2.controls import Controls
from hardware.cameras.v4l2.driver import V4l2Camera
from hardware.cameras.v4l2.negotiation import Mode
from hardware.cameras.v4l2.port import KernelPort
from hardware.errors import DeviceBusy, DeviceNotFound, HardwareError, LinkLost, ProtocolError
from tests.support.v4l2_device import (
    AUTO_EXPOSURE,
    AUTO_WHITE_BALANCE,
    EXPOSURE,
    EXPOSURE_PRIORITY,
    GAIN,
    WHITE_BALANCE,
    VideoDevice,
)
from tests.support.v4l2_emulator import VideoPortEmulator

pytestmark = pytest.mark.live

PATH = "/dev/v4l/by-id/usb-Emulated_Camera-video-index0"
MODE = Mode(32, 16, 30.0)


def yuyv(rgb):
    """BT.601, limited range, from the standard's own coefficients."""
    r, g, b = np.moveaxis(np.asarray(rgb, dtype=float) / 255.0, -1, 0)
    y = 0.299 * r + 0.587 * g + 0.114 * b
    u, v = 128 + 224 * (b - y) / 1.772, 128 + 224 * (r - y) / 1.402
    u, v = (u[:, ::2] + u[:, 1::2]) / 2, (v[:, ::2] + v[:, 1::2]) / 2
    packed = np.stack([16 + 219 * y, np.stack([u, v], axis=2).reshape(y.shape)], axis=2)
    return np.round(packed).astype(np.uint8)


def smooth(height=16, width=32, seed=0):
    rng = np.random.default_rng(seed)
    small = rng.integers(30, 220, (3, 4, 3), dtype=np.uint8)
    # Pairs of equal columns: packed formats share the colour of two pixels.
    return np.repeat(cv2.resize(small, (width // 2, height), interpolation=cv2.INTER_LINEAR), 2, axis=1)


def device(**options):
    return VideoDevice(formats={"YUYV": [(32, 16), (640, 480)], "MJPG": [(32, 16)]}, **options)


def camera(video, mode=MODE, **options):
    options.setdefault("skip_frames", 0)
    return V4l2Camera(PATH, mode, port=VideoPortEmulator({PATH: video}), **options)


@pytest.fixture
def video():
    return device()


@pytest.fixture
def opened(video):
    cam = camera(video)
    cam.open()
    yield cam
    cam.close()


def test_frame_has_the_kernels_stamp_and_number_and_the_right_colours(video, opened):
    rgb = smooth()
    stamp_ns = time.monotonic_ns() - 20_000_000
    video.expose(yuyv(rgb).tobytes(), stamp_ns)
    offset_ns = time.time_ns() - time.monotonic_ns()
    frame = opened.read(1.0)
    assert frame.stamp_mono_ns == stamp_ns // 1000 * 1000
    assert abs(frame.stamp_realtime_ns - frame.stamp_mono_ns - offset_ns) < 5_000_000
    assert frame.sequence == 0
    assert np.abs(frame.rgb.astype(int) - rgb).max() <= 3
    assert not frame.rgb.flags.writeable
    assert opened.identity.card == "Emulated Camera"


def test_frame_survives_the_reuse_of_its_buffer(video, opened):
    video.expose(bytes(32 * 16 * 2))
    first = opened.read(1.0)
    before = first.rgb.copy()
    for _ in range(8):
        video.expose(b"\xeb\x80" * 32 * 16)
        assert opened.read(1.0).rgb.mean() > 250
    np.testing.assert_array_equal(first.rgb, before)


@pytest.mark.parametrize(
    ("name", "pack"),
    [
        ("UYVY", lambda rgb: yuyv(rgb)[:, :, ::-1]),
        ("RGB3", lambda rgb: rgb),
        ("BGR3", lambda rgb: rgb[:, :, ::-1]),
        ("GREY", lambda rgb: rgb[:, :, 1:2]),
    ],
)
def test_other_packed_formats_with_padded_rows(name, pack):
    video = VideoDevice(formats={name: [(32, 16)]}, padding_bytes=24)
    cam = camera(video, Mode(32, 16, 30.0, name))
    cam.open()
    rgb = smooth(seed=2)
    rows = np.asarray(pack(rgb)).reshape(16, -1)
    video.expose(np.pad(rows, ((0, 0), (0, 24)), constant_values=77).tobytes())
    expected = np.repeat(rgb[:, :, 1:2], 3, axis=2) if name == "GREY" else rgb
    tolerance = 3 if name == "UYVY" else 0
    assert np.abs(cam.read(1.0).rgb.astype(int) - expected).max() <= tolerance
    cam.close()


def test_nv12():
    video = VideoDevice(formats={"NV12": [(32, 16)]})
    cam = camera(video, Mode(32, 16, 30.0, "NV12"))
    cam.open()
    grey = np.concatenate([np.full(32 * 16, 126, np.uint8), np.full(32 * 8, 128, np.uint8)])
    video.expose(grey.tobytes())
    assert np.abs(cam.read(1.0).rgb.astype(int) - 128).max() <= 1
    cam.close()


def test_motion_jpeg_and_a_damaged_one(video):
    cam = camera(video, Mode(32, 16, 30.0, "MJPG"))
    cam.open()
    rows, columns = np.mgrid[0:16, 0:32]
    rgb = np.stack([8 * rows + 40, 4 * columns + 60, 200 - 3 * rows], axis=2).astype(np.uint8)
    data = cv2.imencode(".jpg", rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    video.expose(b"\xff\xd8 not a picture")
    assert cam.read(0.0) is None
    video.expose(data)
    frame = cam.read(1.0)
    assert np.abs(frame.rgb.astype(int) - rgb).mean() < 3.0
    assert frame.sequence == 1
    assert cam.counters()["frames_damaged"] == 1
    cam.close()


def test_slow_reader_gets_the_newest_and_the_gap_shows(video, opened):
    for value in (10, 20, 30):
        video.expose(bytes([value, 128]) * 32 * 16)
    frame = opened.read(1.0)
    assert frame.sequence == 2
    assert opened.counters()["frames_passed_over"] == 2
    assert opened.read(0.0) is None


def test_reader_that_slept_through_all_buffers_waits_for_a_fresh_frame(video, opened):
    for _ in range(9):
        video.expose(bytes(32 * 16 * 2))
    assert opened.read(0.0) is None
    video.expose(bytes(32 * 16 * 2))
    assert opened.read(1.0).sequence == 9
    assert opened.counters()["frames_lost"] == 5  # the driver had no buffer for them


def test_damaged_and_short_frames_are_dropped_and_counted(video, opened):
    video.expose(bytes(32 * 16 * 2), damaged=True)
    assert opened.read(0.0) is None
    video.expose(bytes(100))
    assert opened.read(0.0) is None
    video.expose(bytes(32 * 16 * 2))
    assert opened.read(1.0).sequence == 2
    assert opened.counters()["frames_damaged"] == 2


def test_first_frames_are_skipped_after_every_start(video):
    cam = camera(video, skip_frames=2)
    for _ in range(2):
        cam.open()
        for expected in (None, None, 2):
            video.expose(bytes(32 * 16 * 2))
            frame = cam.read(0.0)
            assert (frame and frame.sequence) == expected
    cam.close()


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        (
            Mode(64, 48, 30.0),
            r"expected 64 x 48 YUYV .*got 32 x 16 YUYV; it offers YUYV 32x16@30/15 640x480@30/15; MJPG",
        ),
        (Mode(32, 16, 30.0, "UYVY"), "expected 32 x 16 UYVY .*got 32 x 16 YUYV"),
        (Mode(32, 16, 60.0), "expected 60 Hz .*got 30 Hz"),
    ],
)
def test_mode_that_the_device_replaces_is_refused(video, mode, message):
    cam = camera(video, mode)
    with pytest.raises(ProtocolError, match=message):
        cam.open()
    assert cam._port.open_files == 0


def test_rate_of_29_97_is_30(video):
    video.rates = (29.97,)
    cam = camera(video)
    cam.open()
    cam.close()


def test_controls_are_set_in_order_and_read_back(video):
    cam = camera(video, controls=Controls(exposure_us=8000, gain=20, white_balance_k=4600))
    cam.open()
    values = {number: video.controls[number].value for number in (AUTO_EXPOSURE, EXPOSURE, EXPOSURE_PRIORITY)}
    assert values == {AUTO_EXPOSURE: 1, EXPOSURE: 80, EXPOSURE_PRIORITY: 0}
    assert (video.controls[AUTO_WHITE_BALANCE].value, video.controls[WHITE_BALANCE].value) == (0, 4600)
    assert video.controls[GAIN].value == 20
    cam.close()


def test_control_rounded_to_its_step_is_accepted(video):
    cam = camera(video, controls=Controls(white_balance_k=4605))
    cam.open()
    assert video.controls[WHITE_BALANCE].value == 4600
    cam.close()


def stick(video):
    video.controls[EXPOSURE].stuck = True


def forget(video):
    def automatic(device):
        device.controls[AUTO_EXPOSURE].value = 3

    video.after_start = automatic


@pytest.mark.parametrize(
    ("spoil", "controls", "message"),
    [
        (stick, Controls(exposure_us=8000), "expected .* to set exposure_absolute to 80, got 250"),
        (forget, Controls(exposure_us=8000), "changed auto_exposure from 1 to 3 by itself"),
        (lambda video: None, Controls(gain=300), "expected gain of 0 to 255"),
        (
            lambda video: video.controls.pop(GAIN),
            Controls(gain=3),
            r"no control gain; remove it\. The device has .*brightness",
        ),
    ],
)
def test_control_that_does_not_hold_is_an_error(video, spoil, controls, message):
    spoil(video)
    cam = camera(video, controls=controls)
    with pytest.raises(HardwareError, match=message):
        cam.open()
    assert cam._port.open_files == 0


def test_what_the_device_has_can_be_listed(video):
    port = VideoPortEmulator({PATH: video})
    has = v4l2_controls.available(port, port.open(PATH), PATH)
    assert has["exposure_absolute"] == (3, 2047, 1, 250)
    assert "hue" not in has


@pytest.mark.parametrize("wrong", [{"exposure_us": 0}, {"power_line_hz": 55}, {"others": {"zoom": 1}}])
def test_impossible_controls(wrong):
    with pytest.raises(ValueError, match=r"expected|unknown controls zoom"):
        Controls(**wrong)


def test_missing_device_names_those_that_are_there():
    port = VideoPortEmulator({"/dev/v4l/by-id/usb-Other": device()})
    with pytest.raises(DeviceNotFound, match=f"expected a camera at {PATH}.*here: /dev/v4l/by-id/usb-Other"):
        V4l2Camera(PATH, MODE, port=port).open()


def test_device_of_another_program(video, opened):
    second = V4l2Camera(PATH, MODE, port=opened._port)
    with pytest.raises(DeviceBusy, match=r"in use by another program.*fuser"):
        second.open()
    video.expose(bytes(32 * 16 * 2))
    assert opened.read(1.0) is not None


def test_metadata_device_of_a_webcam():
    with pytest.raises(ProtocolError, match="metadata only; take the device whose name ends in video-index0"):
        camera(device(metadata_only=True)).open()


def test_unplugged_while_waiting_then_back_under_the_same_name(video, opened):
    video.expose(bytes(32 * 16 * 2))
    assert opened.read(1.0) is not None
    video.unplug()
    with pytest.raises(LinkLost, match=r"lost the camera.*unplugged"):
        opened.read(1.0)
    opened.close()
    assert opened._port.open_files == 0
    with pytest.raises(DeviceNotFound):
        opened.open()
    video.plug()
    opened.open()
    video.expose(bytes(32 * 16 * 2))
    assert opened.read(1.0).sequence == 0


def test_rate_is_lowered_by_stamps_with_slots_as_numbers(video):
    cam = camera(video, rate_hz=10.0)
    cam.open()
    start, got = time.monotonic_ns() - 900_000_000, []
    for k in range(24):
        if 12 <= k < 15:
            continue  # three frames that never came
        video.expose(bytes(32 * 16 * 2), start + round(k * 1e9 / 30))
        if (frame := cam.read(0.0)) is not None:
            got.append((frame.sequence, round((frame.stamp_mono_ns - start) / 1e6)))
    # The fourth slot has no frame; its number is missing.
    assert got == [(0, 0), (1, 100), (2, 200), (3, 300), (5, 500), (6, 600), (7, 700)]
    cam.close()


def test_columns_are_cut_out_before_conversion(video):
    cam = camera(video, columns=(0, 16))
    cam.open()
    rgb = smooth(seed=5)
    video.expose(yuyv(rgb).tobytes())
    assert np.abs(cam.read(1.0).rgb.astype(int) - rgb[:, :16]).max() <= 3
    cam.close()


def test_kernel_port_on_what_is_no_camera(tmp_path):
    (tmp_path / "file").write_bytes(b"x")
    cam = V4l2Camera(tmp_path / "file", MODE)
    with pytest.raises(ProtocolError, match="does not do what was asked"):
        cam.open()
    with pytest.raises(DeviceNotFound, match="Is it plugged in"):
        V4l2Camera(tmp_path / "no", MODE).open()
    cam.close()
    with pytest.raises(LinkLost, match="call open"):
        cam.read(0.1)


class WindowSize(ctypes.Structure):
    _fields_ = (
        ("rows", ctypes.c_uint16),
        ("columns", ctypes.c_uint16),
        ("x", ctypes.c_uint16),
        ("y", ctypes.c_uint16),
    )


def test_kernel_port_makes_real_system_calls(tmp_path):
    """On a terminal and a file: the kernel fills structures in place, wakes up, hangs up, maps at an offset."""
    port = KernelPort()
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 33, 77, 0, 0))
    size = WindowSize()
    port.ioctl(slave, termios.TIOCGWINSZ, size)
    assert (size.rows, size.columns) == (33, 77)
    assert not port.wait(master, 0.0)
    os.write(slave, b"x")
    assert port.wait(master, 1.0)
    os.read(master, 1)
    os.close(slave)
    with pytest.raises(OSError, match="No such device"):
        port.wait(master, 1.0)
    os.close(master)
    path = tmp_path / "pages"
    path.write_bytes(bytes(4096) + b"frame" + bytes(4091))
    fd = port.open(path)
    mapped = port.map(fd, 4096, 4096)
    assert mapped[:5] == b"frame"
    mapped.close()
    port.close(fd)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(fd)


@pytest.mark.hardware
def test_first_real_device_delivers_frames():
    port = KernelPort()
    path = next(iter(port.names()))
    fd = port.open(path)
    answer = abi.Format(type=abi.CAPTURE)
    port.ioctl(fd, abi.G_FMT, answer)
    parameters = abi.StreamParameters(type=abi.CAPTURE)
    port.ioctl(fd, abi.G_PARM, parameters)
    port.close(fd)
    pix, interval = answer.fmt.pix, parameters.parm.capture.timeperframe
    mode = Mode(
        pix.width, pix.height, interval.denominator / interval.numerator, abi.fourcc_name(pix.pixelformat)
    )
    cam = V4l2Camera(path, mode)
    cam.open()
    frames = [frame for _ in range(10) if (frame := cam.read(2.0)) is not None]
    cam.close()
    assert len(frames) >= 5
    stamps = [frame.stamp_mono_ns for frame in frames]
    assert stamps == sorted(set(stamps))
    assert cam.counters()["stamps_replaced"] == 0
