"""What every camera driver must do, asked of every camera driver."""

import itertools
import time

import cv2
import numpy as np
import pytest

from hardware.cameras.file import FileCamera
from hardware.cameras.interface import RECORDED, Camera
from hardware.cameras.steady import SteadyCamera
from hardware.errors import DeviceNotFound, LinkLost
from nodes.lab.camera_check import CHECKS, CameraBench
from tests.support.camera_rigs import RIGS

DRIVEN = [name for name, kind in RIGS.items() if kind.driven]
SELF_TIMED = [name for name in RIGS if name not in DRIVEN]


@pytest.fixture
def rig(request, tmp_path):
    if request.param == "oak":
        pytest.importorskip("depthai")
    rig = RIGS[request.param](tmp_path)
    yield rig
    rig.close()


def every(names=tuple(RIGS)):
    return pytest.mark.parametrize("rig", names, indirect=True)


def next_frame(rig):
    rig.produce()
    frame = rig.camera.read(1.0)
    assert frame is not None
    return frame


def first_frame(rig, read):
    """The first frame after a start; a server may take a moment to notice its new client."""
    for _ in range(20):
        rig.produce()
        if (frame := read(0.1)) is not None:
            return frame
    raise AssertionError("no frame")


@pytest.mark.parametrize("check", CHECKS)
@every()
def test_every_driver_keeps_the_contract(rig, check):
    bench = CameraBench(rig.camera, rig.produce)
    assert CHECKS[check](bench)
    with pytest.raises(LinkLost, match=r"call open\(\) first"):
        rig.camera.read(0.01)


@every()
def test_drivers_derive_from_the_interface(rig):
    assert Camera in type(rig.camera).__mro__


@every()
def test_missing_device_is_one_clear_error(rig, tmp_path):
    camera = rig.missing(tmp_path)
    with pytest.raises(DeviceNotFound, match=r"expected|no such") as caught:
        camera.open()
    assert len(str(caught.value)) > 20
    assert "\n" not in str(caught.value)
    camera.close()


@every()
def test_opening_twice_begins_anew(rig):
    rig.camera.open()
    first = first_frame(rig, rig.camera.read)
    rig.camera.open()
    again = first_frame(rig, rig.camera.read)
    assert again.stamp_mono_ns > first.stamp_mono_ns
    assert next_frame(rig).sequence > again.sequence


@every()
def test_frames_have_their_size_no_gaps_and_new_pixels(rig):
    rig.camera.open()
    frames = [next_frame(rig) for _ in range(4)]
    for frame in frames:
        assert (frame.rgb.shape, frame.rgb.dtype) == (rig.shape, np.uint8)
    for before, after in itertools.pairwise(frames):
        assert after.sequence == before.sequence + 1
        assert after.rgb.mean() != before.rgb.mean()


@every(DRIVEN)
def test_slow_consumer_gets_the_newest_once_and_sees_the_gap(rig):
    rig.camera.open()
    first = next_frame(rig)
    for _ in range(3):
        rig.produce()
    newest = rig.camera.read(1.0)
    assert newest.sequence == first.sequence + 3
    assert rig.camera.read(0.01) is None


@every(SELF_TIMED)
def test_slow_consumer_of_a_recording_gets_no_burst(rig):
    rig.camera.open()
    rig.camera.read(1.0)
    time.sleep(0.1)
    begin, count = time.monotonic(), 0
    while time.monotonic() - begin < 0.05:
        count += rig.camera.read(0.005) is not None
    assert 1 <= count <= (time.monotonic() - begin) * rig.rate_hz + 2


def read_often(camera):
    for _ in range(50):
        camera.read(0.1)


@every([name for name in RIGS if name != "folder"])
def test_device_that_goes_away_is_an_error_and_comes_back(rig):
    rig.camera.open()
    before = next_frame(rig)
    rig.unplug()
    with pytest.raises(LinkLost):
        read_often(rig.camera)
    rig.camera.close()
    with pytest.raises(DeviceNotFound):
        rig.camera.open()
    rig.plug()
    rig.camera.open()
    assert first_frame(rig, rig.camera.read).stamp_mono_ns > before.stamp_mono_ns


class Clock:
    def __init__(self):
        self.now_s, self.slept_s = 100.0, []

    def __call__(self):
        return self.now_s

    def sleep(self, seconds):
        self.slept_s.append(round(seconds, 3))
        self.now_s += seconds


def steady(rig, **options):
    clock = Clock()
    return SteadyCamera(rig.camera, now_s=clock, sleep=clock.sleep, **options), clock


@every(DRIVEN)
def test_stall_is_noticed_and_the_device_opened_anew(rig):
    camera, clock = steady(rig, stall_s=1.0, pauses_s=(0.3, 2.0))
    assert camera.read(0.0) is None  # opens it
    rig.produce()
    assert camera.read(1.0) is not None
    assert camera.error == ""
    clock.now_s += 0.9
    assert camera.read(0.0) is None
    assert camera.error == ""
    clock.now_s += 0.2
    assert camera.read(0.0) is None
    assert camera.error == "the camera is connected but gave no frame for 1 s; reopening it"
    assert camera.read(0.5) is None  # pauses
    assert clock.slept_s == [0.3]
    assert camera.read(0.0) is None
    assert first_frame(rig, camera.read)
    assert camera.error == ""
    assert camera.counters()["camera_stalls"] == 1
    assert camera.counters()["camera_reopened"] == 1


@every(DRIVEN)
def test_unplugged_device_is_tried_again_with_growing_pauses_until_it_is_back(rig):
    camera, clock = steady(rig, pauses_s=(0.3, 1.0))
    camera.read(0.0)
    rig.produce()
    assert camera.read(1.0) is not None
    rig.unplug()
    for _ in range(12):
        assert camera.read(5.0) is None
        if len(clock.slept_s) == 4:
            break
    assert clock.slept_s == [0.3, 0.6, 1.0, 1.0]
    assert camera.error
    rig.plug()
    camera.read(0.0)
    assert first_frame(rig, camera.read)
    assert camera.error == ""
    camera.close()


def test_picture_that_repeats_itself_is_a_stall(tmp_path):
    rig = RIGS["v4l2"](tmp_path)
    camera, _ = steady(rig, repeats=3)
    camera.read(0.0)
    frozen, got = bytes([90, 128]) * (336 * 188), []
    for _ in range(4):
        rig.device.expose(frozen)
        got.append(camera.read(1.0))
    assert [frame is None for frame in got] == [False, True, True, True]
    assert "repeats one image (4 identical frames)" in camera.error
    rig.close()


def test_pictures_are_played_in_the_order_of_their_numbers_without_hidden_files(tmp_path):
    """As another program numbers them, and as macOS copies them to a foreign disk."""
    for number in range(1, 13):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((4, 6, 3), 10 * number, np.uint8))
        (tmp_path / f"._{number}.png").write_bytes(b"resource fork")
    camera = FileCamera(tmp_path, rate_hz=1000.0, loop=False)
    camera.open()
    assert [int(camera.read(5.0).rgb[0, 0, 0]) // 10 for _ in range(12)] == list(range(1, 13))
    assert camera.counters()[RECORDED] == 1.0
