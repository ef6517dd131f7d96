import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter

from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import save_policy
from advnerf_core.policies.view import PolicyView
from calibration.schema import CameraCalibration, load_calibration
from nodes.bags.reader import read_attachments, read_messages
from nodes.bags.writer import BagWriter
from nodes.player import PlayerConfig, PlayerNode
from nodes.runtime.bus import Bus
from nodes.runtime.clock import ManualClock
from nodes.runtime.errors import BagError, NodeFinished
from nodes.runtime.messages import decode, encode, header, pose_message, stamp_ns, types
from nodes.runtime.topics import topic as topic_row
from tests.support.messages import filled
from tests.support.replays import CORNER

pytestmark = pytest.mark.live

ROOT = Path(__file__).parents[2]

START_NS = 1_800_000_000_000_000_000


@pytest.fixture
def bag(tmp_path):
    """Two seconds: poses of the car at 50 Hz, of the board at 10 Hz, one request to arm, one status."""
    arm = encode(filled(types.Arm, header=header(START_NS), arm=True, source="person"))
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/arm", arm, START_NS, START_NS, 0)
        for i in range(100):
            t = START_NS + i * 20_000_000
            writer.write("/vicon/car", encode(pose_message(np.eye(4), t)), t, t, i)
            if i % 5 == 0:
                writer.write("/vicon/board", encode(pose_message(np.eye(4), t)), t + 1, t + 1, i // 5)
    return tmp_path / "bag"


def play(node, clock, step_s=0.01, steps=10_000):
    """All messages with the time at which they came [s], until the node is done."""
    out, start = [], clock.now().mono_ns
    try:
        for _ in range(steps):
            out += [((clock.now().mono_ns - start) / 1e9, o.topic, o.message) for o in node.tick(clock.now())]
            clock.advance(step_s)
    except NodeFinished:
        return out, True
    return out, False


def test_the_workstation_launch_says_what_the_policy_would_have_steered(tmp_path):
    """The whole launch file: pictures with stamps of another year become commands with these stamps."""
    for name, content in read_attachments(CORNER).items():
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    shutil.copy(ROOT / "calibration" / "twin" / "room.yaml", tmp_path)
    camera = load_calibration(CameraCalibration, tmp_path / "camera.yaml")
    view = PolicyView(camera.pinhole, 4, 20, distortion=camera.distortion)
    save_policy(tmp_path / "policy.safetensors", PilotNet(), view, {})
    parameters = {
        "bag": CORNER,
        "policy": tmp_path / "policy.safetensors",
        "attack": tmp_path / "corner.attack.safetensors",
        "calibration": tmp_path,
    }
    command = [sys.executable, "-m", "nodes.cli", "launch", "launch/workstation.launch.yaml"]
    for name, value in parameters.items():
        command += ["--set", f"params.{name}={value}"]
    done = subprocess.run(
        [*command, "--folder", tmp_path / "run"], cwd=ROOT, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    seen = {decoded_stamp(message) for message in read_messages(CORNER, ["/camera/image_raw"])}
    steered = [
        decoded_stamp(message) for message in read_messages(tmp_path / "run" / "bag", ["/policy/drive"])
    ]
    assert len(steered) > len(seen) // 2
    assert set(steered) <= seen


def decoded_stamp(message):
    return stamp_ns(decode(topic_row(message.topic).type, message.cdr))


def test_messages_come_when_they_are_due_and_then_it_is_done(bag):
    node = PlayerNode(PlayerConfig(bag=bag, wait_for=[]), lambda topic: 0)
    assert set(node.publications) == {"/vicon/car", "/vicon/board", "/player/state"}
    out, done = play(node, ManualClock(123, 456))
    assert done
    assert len(out) == 120
    for t, _, cdr in out:
        due_s = (stamp_ns(decode("geometry_msgs/msg/PoseStamped", cdr)) - START_NS) / 1e9
        assert 0 <= t - due_s <= 0.011


@pytest.mark.parametrize(("rate", "duration_s"), [(0.5, 3.96), (2.0, 0.99)])
def test_rate(bag, rate, duration_s):
    out, _ = play(PlayerNode(PlayerConfig(bag=bag, rate=rate, wait_for=[]), lambda topic: 0), ManualClock())
    assert out[-1][0] == pytest.approx(duration_s, abs=0.02)


def test_start_offset_and_topics(bag):
    config = PlayerConfig(bag=bag, start_offset_s=1.5, wait_for=[], topics=["/vicon/board"])
    out, _ = play(PlayerNode(config, lambda topic: 0), ManualClock())
    assert [topic for _, topic, _ in out] == ["/vicon/board"] * 5
    assert out[0][0] == pytest.approx(0.01)


def test_loop_begins_again(bag):
    out, done = play(
        PlayerNode(PlayerConfig(bag=bag, loop=True, wait_for=[]), lambda topic: 0), ManualClock(), steps=600
    )
    assert not done
    assert 355 <= len(out) <= 366  # three rounds of 120, and the beginning of a fourth


def test_waits_for_subscribers(bag):
    there = {"/vicon/car": 0}
    node = PlayerNode(PlayerConfig(bag=bag, wait_for=["/vicon/car"]), lambda topic: there[topic])
    clock = ManualClock()
    assert play(node, clock, steps=50) == ([], False)
    assert node.status() == ("ready", "waiting for subscribers of /vicon/car")
    there["/vicon/car"] = 1
    assert len(play(node, clock)[0]) == 120


def test_any_subscriber_will_do_when_none_is_named(bag):
    there = {"/vicon/car": 0, "/vicon/board": 0}
    node = PlayerNode(PlayerConfig(bag=bag), lambda topic: there[topic])
    assert play(node, ManualClock(), steps=5) == ([], False)
    there["/vicon/board"] = 1
    assert len(play(node, ManualClock())[0]) == 120


def test_a_recording_does_not_ask_for_an_attack(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        request = encode(filled(types.AttackRequest, header=header(START_NS), request_id="a"))
        cancel = encode(types.AttackCancel(header=header(START_NS), request_id="a", reason="", ask_id=""))
        for topic, data in (("/attack/request", request), ("/attack/cancel", cancel)):
            writer.write(topic, data, START_NS, START_NS, 0)
        for k in range(2):
            pose = encode(pose_message(np.eye(4), START_NS))
            writer.write("/vicon/car", pose, START_NS + k, START_NS, k)
    assert PlayerNode(PlayerConfig(bag=tmp_path / "bag"), lambda topic: 0).publications == (
        "/vicon/car",
        "/player/state",
    )


@pytest.mark.parametrize(
    "options", [{"topics": ["/arm"]}, {"remap": {"/arm": "/arm"}}, {"remap": {"/vicon/car": "/twin/reset"}}]
)
def test_a_recording_asks_for_nothing_under_no_name(bag, options):
    with pytest.raises(
        BagError, match=r"expected topics that a recording may publish, got /(arm|twin/reset)"
    ):
        PlayerNode(PlayerConfig(bag=bag, **options), lambda topic: 0)


def test_what_is_never_played_is_named(bag):
    node = PlayerNode(PlayerConfig(bag=bag, wait_for=[]), lambda topic: 0)
    assert node.status() == ("active", "0 messages played; never played: /arm")


def test_topics_that_nobody_here_knows_are_left_out_and_named(tmp_path):
    path = tmp_path / "a.mcap"
    writer = McapWriter(str(path))
    writer.start()
    for topic, typename in (
        ("/chatter", "std_msgs/msg/String"),
        ("/vicon/car", "geometry_msgs/msg/PoseStamped"),
    ):
        channel = writer.register_channel(topic, "cdr", writer.register_schema(typename, "ros2msg", b""))
        cdr = encode(types.String(data="x") if topic == "/chatter" else pose_message(np.eye(4), START_NS))
        writer.add_message(channel, START_NS, cdr, START_NS)
    writer.finish()
    node = PlayerNode(PlayerConfig(bag=path, wait_for=[]), lambda topic: 0)
    assert node.publications == ("/vicon/car", "/player/state")
    out, done = play(node, ManualClock())
    assert (len(out), done) == (1, True)
    assert node.status() == ("active", "1 messages played; not in the topic table: /chatter")


def test_wrong_choices_are_errors(bag, tmp_path):
    with pytest.raises(
        BagError, match="has no topic /camera/image_raw; it has /arm, /vicon/board, /vicon/car"
    ):
        PlayerNode(PlayerConfig(bag=bag, topics=["/camera/image_raw"]), lambda topic: 0)
    with pytest.raises(BagError, match="which is not played; played are /vicon/car"):
        PlayerNode(PlayerConfig(bag=bag, topics=["/vicon/car"], wait_for=["/arm"]), lambda topic: 0)
    with pytest.raises(BagError, match="expected a bag folder"):
        PlayerNode(PlayerConfig(bag=tmp_path / "nothing"), lambda topic: 0)


def test_process_plays_a_bag_to_a_subscriber_and_ends(bag, tmp_path):
    command = [sys.executable, "-m", "nodes.player", "--folder", str(tmp_path), "--set", f"bag={bag}"]
    command += ["--set", "rate=4", "--set", "wait_for=[/vicon/car]"]
    with Bus(tmp_path) as bus:
        bus.subscribe("/vicon/car")
        process = subprocess.Popen(command)
        got, deadline = [], time.monotonic() + 120
        while process.poll() is None and time.monotonic() < deadline:
            bus.wait(0.05)
            got += bus.receive()
        got += bus.receive()
    assert process.returncode == 0
    assert [g.info.sequence for g in got] == list(range(100))
