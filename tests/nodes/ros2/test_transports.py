"""Both transports against other programs on this computer, without ROS."""

import os
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from benchmarks.rclpy_peer import ROOT
from nodes.linking.ros2.routes import Endpoint
from nodes.linking.ros2.transports import chosen_transport, is_loopback_interface
from nodes.ros2 import Ros2Config, Ros2Node
from nodes.runtime.errors import BusError, ConfigError
from nodes.runtime.messages import decode, encode, image_message, stamp_ns, type_hash
from nodes.runtime.node import NodeContext
from tests.support.live.ros2_programs import DOMAIN_ID
from tests.support.live.zenoh_router import settings_of
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live
only_dds = pytest.mark.parametrize("transport", ["dds"], indirect=True)

IMAGE, TWIST = "sensor_msgs/msg/Image", "geometry_msgs/msg/TwistStamped"
PIXELS = np.random.default_rng(0).integers(0, 256, (188, 336, 3), dtype=np.uint8)


def test_bytes_come_back_as_they_were_sent(side_of, program, inbox):
    side = side_of([Endpoint("/image_raw", IMAGE, True, 10)], [Endpoint("/echo", IMAGE, True, 10)])
    program("tests.support.live.ros2_echo")
    wait_for(lambda: side.readers_of(0) == 1 and len(side.present(0)) == 1, "the other program")
    time.sleep(0.5)  # the other end of the match
    sent = [encode(image_message(PIXELS, time.time_ns() + k, "camera")) for k in range(20)]
    got = []
    for cdr in sent:
        assert side.write(0, cdr)
        time.sleep(0.03)
        got += [heard for batch in inbox.take() for heard in batch]
    wait_for(
        lambda: (got.extend(h for batch in inbox.take() for h in batch), len(got) == len(sent))[1],
        "the images",
    )
    # DDS pads to four bytes.
    assert [heard.cdr[: len(cdr)] for heard, cdr in zip(got, sent, strict=True)] == sent
    assert {heard.stated_hash for heard in got} == {type_hash(IMAGE)}
    assert {heard.present for heard in got} == {(heard.writer,) for heard in got}
    assert all(0 <= heard.real_ns - heard.source_real_ns < 10**9 for heard in got)


def test_a_publisher_that_leaves_is_followed_by_another(side_of, program, inbox):
    side = side_of([Endpoint("/image_raw", IMAGE, False, 5)], [Endpoint("/cmd_vel", TWIST, True, 10)])
    cdr, writers = encode(image_message(PIXELS, time.time_ns(), "camera")), set()
    for _ in range(2):
        policy = program("tests.support.live.ros2_strangers", "--honest")

        def answered():
            side.write(0, cdr)
            time.sleep(0.05)
            found = {heard.writer for batch in inbox.take() for heard in batch} - writers
            writers.update(found)
            return found

        wait_for(answered, "an answer")
        policy.terminate()
        wait_for(lambda: side.present(0) == (), "the publisher to leave")
    assert len(writers) == 2


@only_dds
def test_other_computers_cannot_reach_the_sockets(side_of):
    from nodes.linking.ros2 import dds

    before = dds._udp_sockets()
    side_of([Endpoint("/image_raw", IMAGE, False, 5)])
    opened = dds._udp_sockets() - before
    assert len(opened) >= 2
    for descriptor in opened:
        with socket.socket(fileno=os.dup(descriptor)) as found:
            assert found.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16).rstrip(b"\0") == b"lo"


@only_dds
def test_a_publisher_with_other_quality_of_service_is_named(side_of, program):
    side = side_of(takes=[Endpoint("/cmd_vel", TWIST, True, 10)])
    assert side.mismatch(0) == ""
    program("tests.support.live.ros2_strangers").ask("unreliable")
    wait_for(lambda: "does not offer reliable delivery" in side.mismatch(0), "the mismatch")
    assert side.present(0) == ()


def test_another_publisher_beside_ours_is_noticed(side_of, program):
    side = side_of([Endpoint("/image_raw", IMAGE, False, 5)], watched=[0])
    assert side.rivals(0) == ()
    program("tests.support.live.ros2_strangers").ask("false_images")
    wait_for(lambda: len(side.rivals(0)) == 1, "the rival")
    wait_for(lambda: side.rivals(0) == (), "the rival to leave")


def test_a_command_answers_an_image_through_the_whole_node(tmp_path, transport, program):
    vehicle = ROOT / "calibration" / "twin" / "vehicle.yaml"
    config = Ros2Config.model_validate(
        {
            "transport": transport,
            "zenoh": settings_of(transport),
            "domain_id": DOMAIN_ID,
            "vehicle": vehicle,
            "send": [{"topic": "/compositor/image", "ros": "/image_raw"}],
            "take": [
                {"topic": "/policy/drive", "ros": "/cmd_vel", "type": TWIST, "answers": "/compositor/image"}
            ],
        }
    )
    from nodes.runtime.clock import SystemClock
    from nodes.runtime.wire import MessageInfo

    clock = SystemClock()
    node = Ros2Node.build(config, NodeContext("ros2", tmp_path, clock))
    try:
        program("tests.support.live.ros2_strangers", "--honest")
        wait_for(lambda: node.counters()["readers /image_raw"] == 1.0, "the subscriber")
        node.tick(clock.now())
        wait_for(lambda: (node.tick(clock.now()), "yet" not in node.status()[1])[1], "the publisher")
        outs, stamps = [], []
        for _ in range(10):
            now = clock.now()
            stamps.append(now.real_ns)
            raw = encode(image_message(PIXELS, now.real_ns, "camera"))
            node.handle("/compositor/image", None, MessageInfo(now.mono_ns, now.mono_ns, raw=raw), now)
            time.sleep(0.1)
            outs += [out for batch in node.inbox.take() for out in node.receive(batch, clock.now())]
        commands = [decode("ackermann_msgs/msg/AckermannDriveStamped", out.message.cdr) for out in outs]
        # The program may find the node's topics a moment later than the node finds the program's.
        assert len(commands) >= 5
        assert [stamp_ns(command) for command in commands] == stamps[-len(commands) :]
        assert {(round(c.drive.speed, 5), round(c.drive.steering_angle, 5)) for c in commands} == {
            (0.7, 0.29)
        }
        assert node.status()[0] == "active"
    finally:
        node.close()
        node.inbox.close()


def test_an_interface_that_is_not_there_is_one_line(tmp_path):
    with pytest.raises(BusError, match="expected a network interface of this computer"):
        is_loopback_interface("nothing0")
    assert is_loopback_interface("lo")


@pytest.mark.parametrize("transport", ["dds", "zenoh"])
def test_a_transport_that_cannot_be_imported_says_what_to_install(tmp_path, monkeypatch, transport):
    module = {"dds": "dds", "zenoh": "zenoh_session"}[transport]
    monkeypatch.setitem(sys.modules, f"nodes.linking.ros2.{module}", None)
    config = Ros2Config.model_validate({"transport": transport, "send": [{"topic": "/odom"}]})
    with pytest.raises(ConfigError, match=r"pip install 'advnerf\[ros2\]'"):
        Ros2Node.build(config, NodeContext("ros2", tmp_path, None))


def test_dds_is_the_transport_where_it_is_installed_and_else_zenoh(monkeypatch):
    installed = {"cyclonedds", "zenoh"}
    monkeypatch.setattr(
        "nodes.linking.ros2.transports.find_spec", lambda name: name if name in installed else None
    )
    assert chosen_transport("auto") == "dds"
    assert chosen_transport("zenoh") == "zenoh"
    installed.remove("cyclonedds")  # as on arm64
    assert chosen_transport("auto") == "zenoh"
    with pytest.raises(ConfigError, match="'transport: zenoh' runs on arm64"):
        chosen_transport("dds")
    installed.clear()
    with pytest.raises(ConfigError, match=r"\(dds or zenoh\), found none; pip install 'advnerf\[ros2\]'"):
        chosen_transport("auto")


def test_a_wrong_file_is_one_line_with_its_place(tmp_path):
    file = tmp_path / "ros2.yaml"
    file.write_text("send:\n  - {topic: /nonsense}\n")
    command = [sys.executable, "-m", "nodes.ros2", "--config", str(file), "--folder", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 2
    assert "unknown topic '/nonsense'" in done.stderr
    assert len(done.stderr.splitlines()) == 1
