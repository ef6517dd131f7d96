"""The doctor before emulated video devices and the window system: absent, wrong, busy and hung."""

import threading
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import pytest

from calibration.schema import CameraCalibration, load_calibration
from hardware.cameras.sources import V4l2Source
from hardware.cameras.v4l2.driver import V4l2Camera
from hardware.cameras.v4l2.negotiation import Mode
from nodes.lab.doctor import cameras, graphics
from nodes.lab.doctor.check import ABSENT, FAILURE, OK, WARNING, DoctorCheck, examine
from tests.support.v4l2_device import VideoDevice
from tests.support.v4l2_emulator import VideoPortEmulator

pytestmark = pytest.mark.live

TWIN = Path(__file__).parents[3] / "calibration" / "twin"


def test_video_devices_with_their_formats_and_without_metadata():
    webcam = VideoDevice(formats={"YUYV": [(640, 480)], "MJPG": [(1280, 720)]})
    port = VideoPortEmulator({"/dev/a": webcam, "/dev/b": VideoDevice(metadata_only=True)})
    (row,) = cameras.video_devices(port)
    assert (row.state, row.found) == (
        OK,
        "/dev/a: Emulated Camera (uvcvideo), YUYV 640x480@30/15; MJPG 1280x720@30/15",
    )
    assert port.open_files == 0
    assert cameras.video_devices(VideoPortEmulator({}))[0].state == ABSENT


def test_a_driver_that_hangs_in_the_kernel_costs_the_deadline():
    never = threading.Event()

    class Hung(VideoPortEmulator):
        def ioctl(self, fd, request, argument):
            never.wait()

    port = Hung({"/dev/a": VideoDevice()})
    (row,) = examine([DoctorCheck("camera", lambda: cameras.video_devices(port), 0.2, "unplug it")])
    never.set()
    assert (row.state, row.found, row.do) == (FAILURE, "no answer within 0.2 s", "unplug it")


class Emulated(V4l2Source):
    """The source of a launch file, before an emulated device."""

    def camera(self):
        mode = Mode(self.width, self.height, self.fps, self.pixel_format)
        return V4l2Camera(
            self.device, mode, rate_hz=self.rate_hz, size=self.size, port=PORTS.get(str(self.device))
        )


PORTS = {}


@contextmanager
def exposing(device, value=128, rate_hz=30.0):
    stop = threading.Event()
    pixels = device.width * device.height

    def expose():
        for number in count():
            if stop.wait(1.0 / rate_hz):
                break
            device.expose(bytes([value + number % 2, 128]) * pixels)  # no two pictures of a sensor are alike

    thread = threading.Thread(target=expose)
    thread.start()
    PORTS["/dev/video7"] = VideoPortEmulator({"/dev/video7": device})
    try:
        yield Emulated(device="/dev/video7", width=320, height=240, rate_hz=None, stall_s=0.2)
    finally:
        stop.set()
        thread.join()
        PORTS.clear()


def test_a_source_is_measured_and_compared():
    device = VideoDevice(formats={"YUYV": [(320, 240)]})
    with exposing(device) as source:
        camera = load_calibration(CameraCalibration, TWIN / "camera.yaml")
        rows = cameras.source(source, camera)
        assert rows[0].found.startswith("v4l2: 320 x 240, ")
        assert "brightness 1" in rows[0].found
        assert ("calibrated for 336 x 188", FAILURE) in {(row.found, row.state) for row in rows}
        assert "by-id" in rows[-1].do
        assert [row.state for row in cameras.source(source)] == [OK, WARNING]
        slow = source.model_copy(update={"rate_hz": 30.0, "fps": 30.0})
        device.rates = (30.0,)
    with exposing(device, value=16, rate_hz=12.0):
        found = [row.found for row in cameras.source(slow)]
        assert "expected 30.0 Hz" in found
        assert "the image is black or white" in found


def test_a_source_that_is_absent_silent_or_taken():
    device = VideoDevice(formats={"YUYV": [(320, 240)]})
    with exposing(device, rate_hz=0.01) as source:
        (row,) = cameras.source(source, timeout_s=0.6)
        assert (row.state, "got 0 in 0.6 s" in row.found) == (FAILURE, True)
    PORTS["/dev/video7"] = VideoPortEmulator({})
    (row,) = cameras.source(source, timeout_s=0.3)
    PORTS.clear()
    assert "expected a camera at /dev/video7, found none" in row.found


def test_screens_come_from_a_process_of_their_own(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    (row,) = graphics.screens()
    assert (row.state, "no window system" in row.found) == (ABSENT, True)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    from nodes.monitor import MonitorOutputConfig

    assert graphics.screens()[0].state == OK
    rows = graphics.screens(MonitorOutputConfig(index=9, connector="HDMI-A-7"))
    assert rows[1].found == "no screen with index 9"
    assert "no monitor at HDMI-A-7" in graphics.screens(MonitorOutputConfig(connector="HDMI-A-7"))[1].found
