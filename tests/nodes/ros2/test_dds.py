"""The DDS end against other DDS programs on this computer, without ROS."""

import json
import os
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from benchmarks.rclpy_peer import ROOT
from nodes.linking.ros2.routes import Endpoint
from nodes.ros2 import Ros2Config, Ros2Node
from nodes.runtime.errors import BusError, ConfigError
from nodes.runtime.inbox import Inbox
from nodes.runtime.messages import decode, encode, image_message, stamp_ns, type_hash
from nodes.runtime.node import NodeContext

pytest.importorskip("cyclonedds")
from nodes.linking.ros2 import dds

pytestmark = pytest.mark.live

DOMAIN = 81
IMAGE, TWIST = "sensor_msgs/msg/Image", "geometry_msgs/msg/TwistStamped"
PIXELS = np.random.default_rng(0).integers(0, 256, (188, 336, 3), dtype=np.uint8)


@pytest.fixture
def inbox():
    found = Inbox(100)
    yield found
    found.close()


@pytest.fixture
def participant_of(inbox):
    made = []

    def make(sends=(), takes=(), **how):
        made.append(dds.Participant(DOMAIN, "lo", sends, takes, inbox, **how))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture
def program():
    """Start another DDS program."""
    made = []

    def make(module, *arguments):
        command = [sys.executable, "-m", module, str(DOMAIN), *arguments]
        pipe = subprocess.PIPE
        made.append(
            subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True)
        )
        assert made[-1].stdout.readline() == "ready\n"
        return made[-1]

    yield make
    for each in made:
        each.kill()
        each.communicate()


def ask(process, kind, seconds=2.0):
    process.stdin.write(json.dumps({"kind": kind, "seconds": seconds, "seed": 0}) + "\n")
    process.stdin.flush()


def wait_until(condition, timeout_s=60.0):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_bytes_come_back_as_they_were_sent(participant_of, program, inbox):
    participant = participant_of(
        [Endpoint("/image_raw", IMAGE, True, 10)], [Endpoint("/echo", IMAGE, True, 10)]
    )
    program("tests.support.dds_echo")
    wait_until(lambda: participant.readers_of(0) == 1 and len(participant.present(0)) == 1)
    time.sleep(0.5)  # the other end of the match
    sent = [encode(image_message(PIXELS, time.time_ns() + k, "camera")) for k in range(20)]
    got = []
    for cdr in sent:
        assert participant.write(0, cdr)
        time.sleep(0.03)
        got += [heard for batch in inbox.take() for heard in batch]
    wait_until(lambda: (got.extend(h for batch in inbox.take() for h in batch), len(got) == len(sent))[1])
    # The middleware pads to four bytes.
    assert [heard.cdr[: len(cdr)] for heard, cdr in zip(got, sent, strict=True)] == sent
    assert {heard.stated_hash for heard in got} == {type_hash(IMAGE)}
    assert {heard.present for heard in got} == {(heard.writer,) for heard in got}
    assert all(0 <= heard.real_ns - heard.source_real_ns < 10**9 for heard in got)


def test_a_publisher_that_leaves_is_followed_by_another(participant_of, program, inbox):
    participant = participant_of(
        [Endpoint("/image_raw", IMAGE, False, 5)], [Endpoint("/cmd_vel", TWIST, True, 10)]
    )
    cdr, writers = encode(image_message(PIXELS, time.time_ns(), "camera")), set()
    for _ in range(2):
        policy = program("tests.support.live.dds_strangers", "--honest")

        def answered():
            participant.write(0, cdr)
            time.sleep(0.05)
            found = {heard.writer for batch in inbox.take() for heard in batch} - writers
            writers.update(found)
            return found

        wait_until(answered)
        policy.terminate()
        wait_until(lambda: participant.present(0) == ())
    assert len(writers) == 2


def test_other_computers_cannot_reach_the_sockets(participant_of):
    before = dds._udp_sockets()
    participant_of([Endpoint("/image_raw", IMAGE, False, 5)])
    opened = dds._udp_sockets() - before
    assert len(opened) >= 2
    for descriptor in opened:
        with socket.socket(fileno=os.dup(descriptor)) as found:
            assert found.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16).rstrip(b"\0") == b"lo"


def test_a_publisher_with_other_quality_of_service_is_named(participant_of, program):
    participant = participant_of(takes=[Endpoint("/cmd_vel", TWIST, True, 10)])
    assert participant.mismatch(0) == ""
    ask(program("tests.support.live.dds_strangers"), "unreliable")
    wait_until(lambda: "does not offer reliable delivery" in participant.mismatch(0))
    assert participant.present(0) == ()


def test_another_publisher_beside_ours_is_noticed(participant_of, program):
    participant = participant_of([Endpoint("/image_raw", IMAGE, False, 5)], watched=[0])
    assert participant.rivals(0) == ()
    ask(program("tests.support.live.dds_strangers"), "false_images")
    wait_until(lambda: len(participant.rivals(0)) == 1)
    wait_until(lambda: participant.rivals(0) == ())


def test_a_command_answers_an_image_through_the_whole_node(tmp_path, program):
    vehicle = ROOT / "calibration" / "twin" / "vehicle.yaml"
    config = Ros2Config.model_validate(
        {
            "domain_id": DOMAIN,
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
        program("tests.support.live.dds_strangers", "--honest")
        wait_until(lambda: node.counters()["readers /image_raw"] == 1.0)
        node.tick(clock.now())
        wait_until(lambda: (node.tick(clock.now()), "yet" not in node.status()[1])[1])
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
        dds.is_loopback_interface("nothing0")
    assert dds.is_loopback_interface("lo")


def test_without_cyclone_dds_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "nodes.linking.ros2.dds", None)
    config = Ros2Config.model_validate({"send": [{"topic": "/odom"}]})
    with pytest.raises(ConfigError, match=r"pip install 'advnerf\[ros2\]'"):
        Ros2Node.build(config, NodeContext("ros2", tmp_path, None))


def test_a_wrong_file_is_one_line_with_its_place(tmp_path):
    file = tmp_path / "ros2.yaml"
    file.write_text("send:\n  - {topic: /nonsense}\n")
    command = [sys.executable, "-m", "nodes.ros2", "--config", str(file), "--folder", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 2
    assert "unknown topic '/nonsense'" in done.stderr
    assert len(done.stderr.splitlines()) == 1
