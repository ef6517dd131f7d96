"""Cameras on real sockets and files."""

import socket
import threading
import time
from contextlib import closing
from dataclasses import replace

import cv2
import numpy as np
import pytest

from hardware.cameras.file import FileCamera
from hardware.cameras.frame_wire import HEAD_BYTES, decode_frame, encode_head
from hardware.cameras.interface import Frame
from hardware.cameras.socket import SocketCamera
from hardware.cameras.sources import SocketSource
from hardware.emulators.frame_server import FrameServer
from hardware.errors import DeviceBusy, DeviceNotFound, LinkLost, LinkTimeout, ProtocolError
from tests.support.sockets import connected
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live


def frame(sequence, shape=(188, 336, 3)):
    rng = np.random.default_rng(sequence)
    return Frame(
        rng.integers(0, 255, shape, dtype=np.uint8), 10**18 + sequence, 5 * 10**9 + sequence, sequence
    )


def test_head_round_trip():
    sent = frame(3, (4, 5, 3))
    got = decode_frame(encode_head(sent), sent.rgb.tobytes())
    assert (got.stamp_realtime_ns, got.stamp_mono_ns, got.sequence) == (10**18 + 3, 5 * 10**9 + 3, 3)
    np.testing.assert_array_equal(got.rgb, sent.rgb)
    with pytest.raises(ProtocolError, match="60 pixel bytes"):
        decode_frame(encode_head(sent), b"abc")


def test_frames_come_through_with_their_stamps(tmp_path):
    with FrameServer(tmp_path / "frames") as server, connected(tmp_path / "frames") as camera:
        wait_for(lambda: server.clients == 1, "the client")
        assert camera.read(timeout_s=0.02) is None
        for sequence in range(5):
            server.publish(frame(sequence))
            got = camera.read(timeout_s=60.0)
            assert (got.sequence, got.stamp_realtime_ns) == (sequence, 10**18 + sequence)
            np.testing.assert_array_equal(got.rgb, frame(sequence).rgb)
            assert not got.rgb.flags.writeable


@pytest.mark.parametrize("simulated", [False, True])
def test_a_frozen_camera_behind_a_socket_is_noticed_and_a_simulated_car_may_stand(tmp_path, simulated):
    """Your own server gives one picture with new stamps; the simulated lab does so while its car stands."""
    camera = SocketSource(path=tmp_path / "frames").steady()
    with FrameServer(tmp_path / "frames") as server, closing(camera):
        assert camera.read(timeout_s=0.02) is None  # opens it
        wait_for(lambda: server.clients == 1, "the client")
        got = []
        for sequence in range(16):
            server.publish(replace(frame(sequence), rgb=frame(0).rgb, simulated=simulated))
            got.append(camera.read(timeout_s=60.0))
        assert [each is not None for each in got] == [True] + 15 * [simulated]
        assert camera.error == "" if simulated else "repeats one image (16 identical" in camera.error


@pytest.mark.parametrize("gave_up_before", [False, True])
def test_a_reader_that_slept_gets_the_newest_and_no_backlog(tmp_path, gave_up_before):
    with FrameServer(tmp_path / "frames") as server, connected(tmp_path / "frames") as camera:
        wait_for(lambda: server.clients == 1, "the client")
        if gave_up_before:
            assert camera.read(timeout_s=0.01) is None
        for sequence in range(30):
            server.publish(frame(sequence))
            time.sleep(0.002)
        assert camera.read(timeout_s=60.0).sequence == 29
        assert camera.read(timeout_s=0.05) is None
        server.publish(frame(30))
        assert camera.read(timeout_s=60.0).sequence == 30


def test_server_that_ends_is_a_lost_link_and_can_be_reopened(tmp_path):
    path = tmp_path / "frames"
    camera = SocketCamera(path)
    with pytest.raises(DeviceNotFound, match="is the twin"):
        camera.open()
    with FrameServer(path) as server:
        camera.open()
        wait_for(lambda: server.clients == 1, "the client")
    with pytest.raises(LinkLost, match="closed the connection"):
        camera.read(timeout_s=60.0)
    assert not path.exists()
    with FrameServer(path) as server:
        camera.open()
        wait_for(lambda: server.clients == 1, "the client")
        server.publish(frame(1))
        assert camera.read(timeout_s=60.0).sequence == 1
    camera.close()
    with pytest.raises(LinkLost, match="open"):
        camera.read(timeout_s=0.1)


def test_two_servers_on_one_path(tmp_path):
    with FrameServer(tmp_path / "frames"), pytest.raises(DeviceBusy, match="answers there"):
        FrameServer(tmp_path / "frames")


def test_a_dead_socket_file_is_replaced(tmp_path):
    dead = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    dead.bind(str(tmp_path / "frames"))
    dead.close()
    with FrameServer(tmp_path / "frames"), connected(tmp_path / "frames"):
        pass


@pytest.mark.parametrize(
    ("sent", "error"),
    [(b"HTTP/1.1 200 OK" + bytes(40), ProtocolError), (encode_head(frame(0)) + b"abc", LinkTimeout)],
)
def test_a_server_that_talks_nonsense_or_stalls(tmp_path, sent, error):
    path = str(tmp_path / "frames")
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(path)
    listener.listen()
    camera = SocketCamera(path, stall_s=0.05)
    camera.open()
    client, _ = listener.accept()
    threading.Thread(target=client.sendall, args=(sent,)).start()
    with pytest.raises(error):
        camera.read(timeout_s=60.0)
    for end in (client, listener, camera):
        end.close()
    assert HEAD_BYTES < 40


def test_file_camera_plays_in_order_at_its_rate(tmp_path):
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k:03d}.png"), np.full((4, 6, 3), (10 * k, 0, 200), dtype=np.uint8))
    camera = FileCamera(tmp_path, rate_hz=50.0, loop=False)
    camera.open()
    start = time.monotonic()
    frames = [camera.read(timeout_s=60.0) for _ in range(3)]
    assert time.monotonic() - start > 0.03
    assert [f.sequence for f in frames] == [0, 1, 2]
    assert frames[2].rgb[0, 0].tolist() == [200, 0, 20]
    with pytest.raises(LinkLost, match="all 3 images"):
        camera.read(timeout_s=60.0)
    camera.close()


def test_file_camera_without_images(tmp_path):
    with pytest.raises(DeviceNotFound, match="found none"):
        FileCamera(tmp_path).open()


def test_file_camera_with_a_broken_image(tmp_path):
    (tmp_path / "a.png").write_bytes(b"not a picture")
    camera = FileCamera(tmp_path)
    camera.open()
    with pytest.raises(LinkLost, match="cannot decode"):
        camera.read(timeout_s=60.0)
