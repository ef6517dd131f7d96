"""OAK cameras through depthai's own host-side graph: real queues and messages, without a device."""

import cv2
import numpy as np
import pytest

from hardware.cameras.oak import OakCamera, OakSource, OakStream, device_stream, find_device, fix_controls
from hardware.cameras.stamping import Stamper
from hardware.errors import DeviceNotFound, HardwareError, LinkLost, ProtocolError

pytestmark = pytest.mark.live

dai = pytest.importorskip("depthai")


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("oak") / "clip.mp4"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10, (336, 188))
    for k in range(12):
        picture = np.zeros((188, 336, 3), np.uint8)
        picture[:] = (20 * k, 30, 200)  # BGR
        video.write(picture)
    video.release()
    return path


def replay(clip, fps=60.0):
    def build(depthai, settings):
        pipeline = depthai.Pipeline(False)
        player = pipeline.create(depthai.node.ReplayVideo)
        player.setReplayVideoFile(clip)
        player.setFps(fps)
        player.setLoop(False)
        player.setOutFrameType(depthai.ImgFrame.Type.BGR888i)
        return OakStream(pipeline, player.out.createOutputQueue(maxSize=1, blocking=False))

    return build


def read_into(frames, camera):
    while len(frames) < 100:
        if (frame := camera.read(0.5)) is not None:
            frames.append(frame)


def test_replayed_video_comes_out_as_rgb_until_its_end(clip):
    camera = OakCamera(OakSource(), replay(clip))
    camera.open()
    frames = []
    with pytest.raises(LinkLost, match=r"lost the OAK: .*closed"):
        read_into(frames, camera)
    assert len(frames) >= 6
    assert [f.sequence for f in frames] == sorted({f.sequence for f in frames})
    for frame in frames:
        expected = (200, 30, 20 * frame.sequence)
        assert np.abs(frame.rgb.reshape(-1, 3).astype(float).mean(axis=0) - expected).max() < 8
    stamps = [f.stamp_mono_ns for f in frames]
    assert stamps == sorted(set(stamps))
    assert camera.counters() == {"stamps_replaced": 0, "stamps_refused": 0}
    camera.close()


def test_stamp_is_depthais_own_and_not_that_of_receipt(clip):
    later = Stamper(monotonic_ns=lambda: round(dai.Clock.now().total_seconds() * 1e9) + 3_600_000_000_000)
    camera = OakCamera(OakSource(), replay(clip, fps=5.0), later)
    camera.open()
    frame = camera.read(60.0)
    assert round(dai.Clock.now().total_seconds() * 1e9) - frame.stamp_mono_ns < 1_800_000_000_000
    camera.close()


def test_pictures_of_another_size_are_refused(clip):
    camera = OakCamera(OakSource(width=640, height=400), replay(clip))
    camera.open()
    with pytest.raises(
        ProtocolError, match=r"expected images \[400, 640, 3\] from the OAK, got \[188, 336, 3\]"
    ):
        camera.read(1.0)
    camera.close()


class Info:
    def __init__(self, device_id, name):
        self._id, self.name = device_id, name

    def getDeviceId(self):
        return self._id


class Listing:
    """depthai's list of devices, with some in it."""

    DeviceInfo = dai.DeviceInfo

    def __init__(self, *found):
        self.Device = type("Device", (), {"getAllAvailableDevices": staticmethod(lambda: list(found))})


def test_device_is_chosen_by_id_or_address():
    one, two = Info("14442C10D1", "1.4"), Info("19443010AA", "192.168.1.222")
    assert find_device(Listing(one), "") is one
    assert find_device(Listing(one, two), "19443010AA") is two
    assert find_device(Listing(one, two), "192.168.1.222") is two
    with pytest.raises(DeviceNotFound, match=r"expected one OAK, found 14442C10D1 \(1.4\), 19443010AA"):
        find_device(Listing(one, two), "")
    with pytest.raises(DeviceNotFound, match="expected the OAK 99, found 14442C10D1"):
        find_device(Listing(one), "99")
    assert find_device(Listing(), "10.0.0.7").name == "10.0.0.7"


def test_no_device_is_said_at_once_with_the_cure():
    with pytest.raises(DeviceNotFound, match=r"expected an OAK, found none.*udev rules"):
        device_stream(dai, OakSource())


def test_controls_reach_depthais_own_structure():
    control = dai.CameraControl()
    fix_controls(control, OakSource(exposure_us=8000, iso=250, white_balance_k=5000))
    assert control.getExposureTime().total_seconds() == pytest.approx(0.008)
    assert control.getSensitivity() == 250
    automatic = dai.CameraControl()
    fix_controls(automatic, OakSource())
    assert automatic.getExposureTime().total_seconds() == 0.0


@pytest.mark.parametrize(
    "wrong",
    [{"fps": 0.0}, {"iso": 200}, {"exposure_us": 8000, "iso": 20}, {"white_balance_k": 100}, {"width": 0}],
)
def test_impossible_settings(wrong):
    with pytest.raises(ValueError, match=r"expected|should be greater than 0"):
        OakSource(**wrong)


def test_depthai_that_is_not_installed(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "depthai", None)
    with pytest.raises(HardwareError, match=r"pip install 'advnerf\[oak\]'"):
        OakCamera(OakSource()).open()
