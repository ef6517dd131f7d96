"""The camera node with every kind of source, on emulated devices, sockets and files."""

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from calibration.schema import CameraCalibration, load_calibration
from hardware.cameras.interface import Frame
from hardware.cameras.sources import CameraSource
from hardware.cameras.steady import SteadyCamera
from hardware.cameras.v4l2.driver import V4l2Camera
from hardware.cameras.v4l2.negotiation import Mode
from hardware.cameras.zed.driver import ZedCamera, ZedSource
from nodes.camera import CameraNode, CameraNodeConfig
from nodes.launching.launch_file import load_launch
from nodes.runtime.bus import Bus
from nodes.runtime.clock import SystemClock
from nodes.runtime.config import load_node_config
from nodes.runtime.errors import ConfigError, RuntimeFault
from nodes.runtime.messages import ns_from_stamp
from nodes.runtime.node import NodeContext
from nodes.runtime.pictures import rgb_image
from tests.support.camera_info import pinhole_from_camera_info
from tests.support.v4l2_device import VideoDevice
from tests.support.v4l2_emulator import VideoPortEmulator
from tests.support.waiting import wait_for
from tests.support.zed_emulator import ZedRegisters

pytestmark = pytest.mark.live

TWIN = Path(__file__).parents[2] / "calibration" / "twin" / "camera.yaml"
CLOCK = SystemClock()
PATH = "/dev/v4l/by-id/usb-Camera-video-index0"
SOURCE = TypeAdapter(CameraSource)


def frame(sequence=0, stamp_s=0.0):
    now = CLOCK.now()
    ns = round(stamp_s * 1e9)
    return Frame(
        np.full((188, 336, 3), 50 + sequence, np.uint8), now.real_ns + ns, now.mono_ns + ns, sequence
    )


def config(source=None, **options):
    source = source or {"kind": "folder", "folder": "pictures"}
    return CameraNodeConfig.model_validate({"source": source, "calibration": str(TWIN), **options})


def node(configuration, subscribers=lambda topic: 1, device=None):
    made = CameraNode(configuration, load_calibration(CameraCalibration, TWIN), subscribers, device)
    made.inbox.close()
    return made


def take(made, count, feed=lambda: None, timeout_s=60.0):
    outs, deadline = [], time.monotonic() + timeout_s
    while len(outs) < count and time.monotonic() < deadline:
        feed()
        for item in made.inbox.take():
            outs += [out for out in made.receive(item, CLOCK.now()) if out.topic == "/camera/image_raw"]
        time.sleep(0.002)
    return outs


# Compressed pictures


def test_compressed_picture_goes_with_the_raw_one_under_the_same_stamp():
    made = node(config(compressed={"rate_hz": 10, "quality": 90}))
    assert "/camera/image_raw/compressed" in made.publications
    raw, info, small = made.receive(frame(3), CLOCK.now())
    assert (raw.topic, info.topic, small.topic) == (
        "/camera/image_raw",
        "/camera/camera_info",
        "/camera/image_raw/compressed",
    )
    assert ns_from_stamp(small.message.header.stamp) == ns_from_stamp(raw.message.header.stamp)
    assert small.message.header.frame_id == raw.message.header.frame_id
    assert np.abs(rgb_image(small.message, "test").astype(int) - rgb_image(raw.message, "test")).max() <= 2


def test_compressed_rate_is_its_own_and_nothing_is_done_for_nobody():
    made = node(config(compressed={"rate_hz": 4}, max_age_s=60))
    topics = [out.topic for k in range(20) for out in made.receive(frame(k, 0.1 * k), CLOCK.now())]
    assert topics.count("/camera/image_raw") == 20
    assert topics.count("/camera/image_raw/compressed") == 8
    # After the clock was set back by ten minutes, the pictures go on.
    back = [
        replace(frame(k, 0.1 * k), stamp_realtime_ns=frame(k, 0.1 * k - 600.0).stamp_realtime_ns)
        for k in range(20, 40)
    ]
    after = [out.topic for each in back for out in made.receive(each, CLOCK.now())]
    assert after.count("/camera/image_raw/compressed") == 8
    alone = node(config(compressed={}), subscribers=lambda topic: 0)
    assert len(alone.receive(frame(), CLOCK.now())) == 2
    without = node(config())
    assert without.publications == ("/camera/image_raw", "/camera/camera_info")
    assert len(without.receive(frame(), CLOCK.now())) == 2


# Sources


def test_every_kind_of_source_makes_its_driver(tmp_path):
    conf = tmp_path / "SN1.conf"
    conf.write_text("[LEFT_CAM_VGA]\nfx=350\nfy=350\ncx=335\ncy=187\n", encoding="utf-8")
    sources = [
        {
            "kind": "v4l2",
            "device": PATH,
            "width": 640,
            "height": 360,
            "size": [336, 188],
            "exposure_us": 8000,
        },
        {"kind": "zed", "device": PATH, "factory": str(conf), "exposure_percent": 40},
        {"kind": "oak", "exposure_us": 8000, "iso": 400},
        {"kind": "socket", "path": "s"},
        {"kind": "file", "path": "v.mp4"},
        {"kind": "folder", "folder": "f", "rate_hz": 0.1},
    ]
    kinds = [type(SOURCE.validate_python(source).steady().camera).__name__ for source in sources]
    assert kinds == ["V4l2Camera", "ZedCamera", "OakCamera", "SocketCamera", "VideoCamera", "FileCamera"]
    assert SOURCE.validate_python(sources[-1]).steady()._stall_s == pytest.approx(30.0)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ({"kind": "v4l2", "device": PATH, "width": 64, "height": 48, "colour": 1}, "colour"),
        ({"kind": "v4l2", "device": PATH, "width": 64, "height": 48, "pixel_format": "H264"}, "YUYV"),
        (
            {"kind": "v4l2", "device": PATH, "width": 64, "height": 48, "rate_hz": 60},
            "at most that of the device, 30 Hz",
        ),
        (
            {"kind": "v4l2", "device": PATH, "width": 64, "height": 48, "controls": {"zoom": 2}},
            "unknown controls zoom",
        ),
        ({"kind": "zed", "device": PATH, "factory": "x", "fps": 10}, "a rate of 15, 30, 60, 100 Hz, got 10"),
        (
            {"kind": "zed", "device": PATH, "factory": "x", "size": [1344, 376]},
            "at most 672 x 376 in mode VGA",
        ),
        ({"kind": "zed", "device": PATH, "factory": "x", "gain_raw": 5}, "exposure_percent with gain_raw"),
        ({"kind": "oak", "iso": 400}, "exposure_us and iso together"),
        ({"kind": "webcam"}, "v4l2.*zed.*oak.*socket.*file.*folder"),
        ({"kind": "file", "folder": "x"}, "path"),
    ],
)
def test_wrong_source(source, message):
    with pytest.raises(ValidationError, match=message):
        config(source)


def test_node_process_says_what_is_wrong_in_one_line(tmp_path):
    command = [sys.executable, "-m", "nodes.camera", "--folder", str(tmp_path), "--check"]
    command += [
        "--set",
        "source={kind: zed, device: /dev/video0, factory: x, fps: 12}",
        "--set",
        f"calibration={TWIN}",
    ]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "expected a rate of 15, 30, 60, 100 Hz, got 12" in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_camera_node_runs_without_depthai_and_torch():
    code = "import nodes.camera, sys; print([m for m in ('depthai', 'torch', 'scipy', 'mujoco') if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_folder_and_video_through_the_whole_node(tmp_path):
    video = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 100.0, (336, 188))
    for k in range(8):
        picture = np.full((188, 336, 3), 20 * k, np.uint8)
        video.write(picture)
        cv2.imwrite(str(tmp_path / f"{k}.png"), picture)
    video.release()
    folder = {"kind": "folder", "folder": str(tmp_path), "rate_hz": 100}
    for source in (folder, {"kind": "file", "path": str(tmp_path / "v.avi")}):
        made = CameraNode.build(config(source), NodeContext("camera", tmp_path, CLOCK))
        outs = take(made, 3)
        made.close()
        made.inbox.close()
        stamps = [ns_from_stamp(out.message.header.stamp) for out in outs]
        assert len(stamps) >= 3
        assert stamps == sorted(set(stamps))
        assert made.status()[0] == "active"


def test_camera_process_sends_both_kinds_of_picture_over_the_bus(tmp_path):
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((188, 336, 3), 30 * k + 20, np.uint8))
    command = [
        sys.executable,
        "-m",
        "nodes.camera",
        "--folder",
        str(tmp_path),
        "--set",
        f"calibration={TWIN}",
    ]
    command += [
        "--set",
        f"source={{kind: folder, folder: {tmp_path}, rate_hz: 50}}",
        "--set",
        "compressed={rate_hz: 25}",
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    raw, small, resident_kb = {}, {}, 0
    try:
        with Bus(tmp_path) as bus:
            bus.subscribe("/camera/image_raw", queue=1000)
            bus.subscribe("/camera/image_raw/compressed", queue=1000)
            deadline = time.monotonic() + 60.0
            while len(small) < 5 and time.monotonic() < deadline:
                bus.wait(0.1)
                for received in bus.receive():
                    message = received.message()
                    kind = raw if received.topic == "/camera/image_raw" else small
                    kind[ns_from_stamp(message.header.stamp)] = rgb_image(message, "test")
            status = Path(f"/proc/{process.pid}/status").read_text()
            resident_kb = int(status.split("VmRSS:")[1].split()[0])
    finally:
        process.terminate()
        _, errors = process.communicate(timeout=600)
    assert (process.returncode, errors) == (0, "")
    both = sorted(raw.keys() & small.keys())
    assert len(both) >= 3
    for stamp in both:
        assert np.abs(small[stamp].astype(int) - raw[stamp]).max() <= 2
    assert len(small) < len(raw)
    assert resident_kb < 80_000


# Devices that misbehave, through the whole node


@pytest.fixture
def webcam():
    device = VideoDevice(formats={"YUYV": [(336, 188)]})
    port = VideoPortEmulator({PATH: device})
    driver = V4l2Camera(PATH, Mode(336, 188, 30.0), skip_frames=0, port=port)
    steady = SteadyCamera(driver, stall_s=0.2, first_frame_s=0.5, pauses_s=(0.02, 0.05))
    made = CameraNode(config(silence_s=0.4), load_calibration(CameraCalibration, TWIN), device=steady)
    made._reader.start()
    yield made, device
    made.close()
    made.inbox.close()
    assert port.open_files == 0


def grey(device):
    device.expose(bytes([120, 128]) * (336 * 188))


def test_unplugged_webcam_is_a_fault_with_its_reason_until_it_is_back(webcam):
    made, device = webcam
    assert len(take(made, 2, lambda: grey(device))) >= 2
    assert made.status()[0] == "active"
    device.unplug()
    made.inbox.take()  # what had come before
    wait_for(lambda: made.status()[0] == "fault", "the fault")
    wait_for(lambda: "expected a camera at /dev/v4l/by-id" in made.status()[1], "its reason")
    device.plug()
    assert take(made, 1, lambda: grey(device))
    assert made.status() == ("active", "")
    assert made.counters()["camera_reopened"] >= 1


def test_webcam_that_stalls_is_opened_anew(webcam):
    made, device = webcam
    assert take(made, 1, lambda: grey(device))
    wait_for(
        lambda: "gave no frame for 0.2 s" in made.status()[1] and made.status()[0] == "fault", "the fault"
    )
    wait_for(lambda: device.streaming, "the stream")
    assert take(made, 1, lambda: grey(device))
    assert made.counters()["camera_stalls"] >= 1


# A device that knows its intrinsics


def zed(tmp_path, fx):
    conf = tmp_path / "SN1.conf"
    conf.write_text(f"[LEFT_CAM_VGA]\nfx={fx}\nfy={fx}\ncx=335.5\ncy=187.5\n", encoding="utf-8")
    device = VideoDevice(formats={"YUYV": [(1344, 376)]}, extension=ZedRegisters())
    return SteadyCamera(ZedCamera(ZedSource(device=PATH, factory=conf), VideoPortEmulator({PATH: device})))


def test_zed_with_its_own_calibration_publishes_the_rectified_pinhole(tmp_path):
    made = node(config(), device=zed(tmp_path, 348.0))
    _, info = made.receive(frame(), CLOCK.now())
    assert pinhole_from_camera_info(info.message).fx == pytest.approx(173.97, abs=0.01)
    assert list(info.message.d) == [0.0] * 5


def test_calibration_of_another_camera_is_refused(tmp_path):
    made = node(config(), device=zed(tmp_path, 280.0))
    with pytest.raises(
        RuntimeFault, match=r"fx 17\d.\d.*factory\s+calibration has fx 14\d.\d.*another camera or\s+mode"
    ):
        made.receive(frame(), CLOCK.now())


# The source in a launch file


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (
            "{kind: v4l2, device: d, width: 6, height: 4, colour: 1}",
            r":1: unknown key source.colour; valid keys here: controls, device,",
        ),
        ("{kind: v4l2, device: d, width: 6}", r":1: source.height is missing"),
        (
            "{kind: v4l2, device: d, width: 6, height: four}",
            r":1: source.height: input should be a valid integer.*got 'four'",
        ),
    ],
)
def test_error_in_a_source_is_told_as_it_was_written(tmp_path, source, message):
    path = tmp_path / "camera.yaml"
    path.write_text(f"source: {source}\ncalibration: c\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        load_node_config(CameraNodeConfig, "camera", path)


def test_source_of_another_kind_replaces_the_one_of_the_included_launch_file(tmp_path):
    (tmp_path / "base.launch.yaml").write_text(
        "name: base\nnodes:\n  camera: {module: nodes.camera, config: {source: {kind: socket, path: s}, calibration: c}}\n"
    )
    above = "name: car\ninclude: [base.launch.yaml]\nnodes:\n  camera: {config: {source: SOURCE}}\n"
    configs = {}
    for name, source in (
        ("other", "{kind: folder, folder: f}"),
        ("same", "{kind: socket, stall_s: 2}"),
        ("none", "{stall_s: 2}"),
    ):
        file = tmp_path / f"{name}.launch.yaml"
        file.write_text(above.replace("SOURCE", source))
        configs[name] = load_launch(file).nodes["camera"].config
    assert configs["other"] == {"source": {"kind": "folder", "folder": "f"}, "calibration": "c"}
    assert configs["same"] == configs["none"]
    assert configs["none"]["source"] == {"kind": "socket", "path": "s", "stall_s": 2}
