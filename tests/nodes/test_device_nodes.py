"""The camera and the VICON node in this process, each against its real protocol: frame socket, UDP."""

import re
import socket
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from advnerf_core.documents import Document
from advnerf_core.geometry import planar_pose
from advnerf_core.strict import validate
from calibration.schema import CalibrationError, CameraCalibration, load_calibration
from hardware.cameras.interface import Frame
from hardware.emulators.frame_server import FrameServer
from hardware.mocap.vicon_codec import encode_blocks, object_pose
from nodes.camera import CameraNode, CameraNodeConfig
from nodes.runtime.clock import SystemClock
from nodes.runtime.errors import ConfigError, RuntimeFault
from nodes.runtime.messages import ns_from_stamp, pose_matrix
from nodes.runtime.pictures import rgb_image
from nodes.vicon import ViconNode, ViconNodeConfig
from tests.support.camera_info import pinhole_from_camera_info
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live

TWIN = Path(__file__).parents[2] / "calibration" / "twin"
CLOCK = SystemClock()


def take(node, timeout_s=60.0):
    """Let the inbox wake the node, as the loop does."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if items := node.inbox.take():
            return [out for item in items for out in node.receive(item, CLOCK.now())]
        time.sleep(0.002)
    return []


# Camera


def frame(sequence=0, age_s=0.0, shape=(188, 336, 3)):
    now = CLOCK.now()
    age_ns = round(age_s * 1e9)
    return Frame(
        np.full(shape, sequence, dtype=np.uint8), now.real_ns - age_ns, now.mono_ns - age_ns, sequence
    )


@pytest.fixture
def camera(tmp_path, node_context):
    config = CameraNodeConfig.model_validate(
        {"source": {"kind": "socket", "path": tmp_path / "frames"}, "calibration": TWIN / "camera.yaml"}
    )
    node = CameraNode.build(config, node_context)
    yield node
    node.close()
    node.inbox.close()


def connected(server):
    wait_for(lambda: server.clients, "the camera node to connect")
    return server


def test_camera_publishes_frames_with_their_own_stamps(camera, tmp_path):
    assert camera.status()[0] == "starting"
    with FrameServer(tmp_path / "frames") as server:
        connected(server).publish(sent := frame(3))
        image, info = take(camera)
    assert (image.topic, info.topic) == ("/camera/image_raw", "/camera/camera_info")
    assert (
        ns_from_stamp(image.message.header.stamp)
        == ns_from_stamp(info.message.header.stamp)
        == sent.stamp_realtime_ns
    )
    np.testing.assert_array_equal(rgb_image(image.message, "test"), sent.rgb)
    assert pinhole_from_camera_info(info.message).cx == 168.0
    assert camera.status() == ("active", "")


def test_camera_counts_gaps_drops_what_is_old_and_survives_a_restart_of_its_device(camera, tmp_path):
    with FrameServer(tmp_path / "frames") as server:
        connected(server).publish(frame(0))
        assert len(take(camera)) == 2
        server.publish(frame(5))
        assert len(take(camera)) == 2
        server.publish(frame(6, age_s=0.5))
        assert take(camera, 0.2) == []
    counted = camera.counters()
    assert (counted["frames_stale"], counted["frames_missed"]) == (1, 4)
    time.sleep(0.6)
    assert camera.status()[0] == "fault"
    with FrameServer(tmp_path / "frames") as server:
        connected(server).publish(frame(0))
        assert len(take(camera)) == 2
    assert camera.status()[0] == "active"


def test_camera_refuses_frames_it_is_not_calibrated_for(camera, tmp_path):
    with FrameServer(tmp_path / "frames") as server:
        connected(server).publish(frame(shape=(188, 366, 3)))
        with pytest.raises(RuntimeFault, match=r"336 x 188.*got 366 x 188; calibrate"):
            take(camera)


def test_camera_subtracts_the_measured_latency(tmp_path):
    calibration = load_calibration(CameraCalibration, TWIN / "camera.yaml").model_copy(
        update={"latency_s": 0.03}
    )
    config = CameraNodeConfig.model_validate(
        {"source": {"kind": "socket", "path": tmp_path / "f"}, "calibration": TWIN / "camera.yaml"}
    )
    node = CameraNode(config, calibration)
    image, _ = node.receive(sent := frame(), CLOCK.now())
    assert ns_from_stamp(image.message.header.stamp) == sent.stamp_realtime_ns - 30_000_000
    node.inbox.close()


def test_camera_without_calibration(tmp_path, node_context):
    config = CameraNodeConfig.model_validate(
        {"source": {"kind": "folder", "folder": tmp_path}, "calibration": tmp_path / "no.yaml"}
    )
    with pytest.raises(CalibrationError, match="no such calibration"):
        CameraNode.build(config, node_context)


# VICON


@pytest.fixture
def vicon(node_context):
    node = ViconNode.build(ViconNodeConfig(port=0, subjects=("car", "board")), node_context)
    yield node
    node.close()
    node.inbox.close()


@pytest.fixture
def tracker():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        yield sender


def send_pose(sender, node, frame_number, name, T):
    for datagram in encode_blocks(frame_number, [object_pose(name, T)]):
        sender.sendto(datagram, ("127.0.0.1", node.port))


def test_vicon_one_topic_for_each_subject(vicon, tracker):
    assert vicon.publications == ("/vicon/car", "/vicon/board")
    assert vicon.status() == ("starting", f"no datagrams on UDP port {vicon.port}")
    send_pose(tracker, vicon, 1, "car", planar_pose(0.5, -0.2, 0.7))
    (out,) = take(vicon)
    assert out.topic == "/vicon/car"
    np.testing.assert_allclose(pose_matrix(out.message), planar_pose(0.5, -0.2, 0.7), atol=1e-9)
    assert abs(ns_from_stamp(out.message.header.stamp) - CLOCK.now().real_ns) < 1e9
    assert vicon.status() == ("active", "not seen: board")


def test_vicon_names_a_sender_that_it_was_not_told_of(tracker, node_context):
    with closing(ViconNode.build(ViconNodeConfig(port=0, source="127.0.0.9"), node_context)) as vicon:
        send_pose(tracker, vicon, 1, "car", planar_pose(0.5, -0.2, 0.7))
        wait_for(lambda: vicon.counters()["from_elsewhere"], "the datagram")
        state, text = vicon.status()
        assert state == "starting"
        assert text.startswith(f"no datagrams on UDP port {vicon.port} from 127.0.0.9, but ")
        assert text.endswith(" from 127.0.0.1; correct source")


@pytest.mark.parametrize("wrong", ["tracker-pc", "192.168.1.300", "127.0.0.1 "])
def test_vicon_refuses_a_source_that_no_datagram_has(wrong):
    with pytest.raises(ConfigError, match="source: expected an IPv4 address"):
        validate(ViconNodeConfig, Document({"source": wrong}, "vicon.yaml"))


def test_vicon_that_loses_the_car_reports_a_fault(vicon, tracker):
    send_pose(tracker, vicon, 1, "car", planar_pose(0.5, -0.2, 0.7))
    take(vicon)
    send_pose(tracker, vicon, 2, "car", np.full((4, 4), np.nan))
    assert take(vicon, 0.6) == []
    assert vicon.status()[0] == "fault"
    assert vicon.counters()["lost car"] == 1


def test_vicon_with_two_senders_is_a_fault_that_withholds_the_poses(vicon, tracker):
    send_pose(tracker, vicon, 1, "car", planar_pose(0.5, -0.2, 0.7))
    assert len(take(vicon)) == 1
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as another:
        send_pose(another, vicon, 2, "car", planar_pose(2.5, -0.2, 0.7))
    items = wait_for(vicon.inbox.take, "the loop to wake up")
    assert items == [[]]  # no pose, and yet the loop wakes up to say so
    state, text = vicon.status()
    assert state == "fault"
    assert re.fullmatch(r"two senders of subject car: 127\.0\.0\.1:\d+ and 127\.0\.0\.1:\d+", text)
    assert vicon.counters()["disputed"] == 1


def test_vicon_subjects_need_topics():
    with pytest.raises(ValidationError, match="unknown topic '/vicon/lamp'"):
        ViconNodeConfig(subjects=("lamp",))
