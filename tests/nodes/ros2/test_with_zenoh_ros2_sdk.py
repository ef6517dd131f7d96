"""The node as a process over Zenoh, against an independent implementation of rmw_zenoh's wire: ``make test-ros2``."""

import hashlib
import json
import time

import numpy as np
import pytest

from advnerf_core.geometry import planar_pose
from benchmarks.rclpy_peer import PEERS, RclpyPeer, peers_have
from nodes.runtime.messages import (
    drive_message,
    image_message,
    pose_message,
    stamp_ns,
    type_definition,
    type_hash,
    types,
)
from nodes.runtime.messages import header as make_header
from tests.support.live.ros2_bridge import Bridge
from tests.support.live.zenoh_router import zenoh_router
from tests.support.waiting import wait_for

pytestmark = [pytest.mark.ros2, pytest.mark.live]
pytest.importorskip("zenoh")

DOMAIN = 77
IMAGE, TWIST = "sensor_msgs/msg/Image", "geometry_msgs/msg/TwistStamped"
POSE, ODOMETRY, ARRAY = (
    "geometry_msgs/msg/PoseStamped",
    "nav_msgs/msg/Odometry",
    "diagnostic_msgs/msg/DiagnosticArray",
)
COMMANDS = {
    "send": [{"topic": "/compositor/image", "ros": "/image_raw"}],
    "take": [{"topic": "/policy/drive", "ros": "/cmd_vel", "type": TWIST, "answers": "/compositor/image"}],
}
PIXELS = np.random.default_rng(0).integers(0, 256, (188, 336, 3), dtype=np.uint8)


@pytest.fixture(autouse=True, scope="module")
def _peers_are_installed():
    if not peers_have("zenoh_ros2_sdk"):
        pytest.skip("no environment with zenoh_ros2_sdk; make setup-ros2 installs one")


@pytest.fixture
def endpoint():
    with zenoh_router() as found:
        yield found


@pytest.fixture
def bridge_of(tmp_path, endpoint):
    made = []

    def make(config):
        zenoh = {"connect": [endpoint]}
        made.append(Bridge(tmp_path, {"transport": "zenoh", "zenoh": zenoh, **config}, DOMAIN))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture
def peer_of(tmp_path, endpoint):
    made = []

    def make(*arguments):
        file = tmp_path / "definitions.json"
        file.write_text(json.dumps({name: parts_of(name) for name in (IMAGE, TWIST, POSE, ODOMETRY, ARRAY)}))
        port = endpoint.rpartition(":")[2]
        made.append(RclpyPeer(DOMAIN, PEERS / "zenoh_answering.py", port, str(DOMAIN), str(file), *arguments))
        return made[-1]

    yield make
    for each in made:
        each.close()


def parts_of(typename):
    """Definition of a type and of each type in it."""
    first, *nested = type_definition(typename).split("=" * 80 + "\n")
    found = {typename: first}
    for part in nested:
        head, _, text = part.partition("\n")
        package, _, name = head.removeprefix("MSG: ").rpartition("/")
        found[f"{package.removesuffix('/msg')}/msg/{name}"] = text
    return found


def of(peer, key):
    return [line for line in peer.lines if key in line]


def watch(bridge, condition, what):
    wait_for(lambda: (bridge.watch(0.05), condition())[1], what, 120.0)


def publish_images(bridge, count):
    """Publish pictures; the digest of each, by its stamp [ns]."""
    sent = {}
    for k in range(count):
        pixels = PIXELS + np.uint8(k)
        stamp = time.time_ns()
        sent[stamp] = hashlib.sha256(pixels.tobytes()).hexdigest()
        bridge.bus.publish("/compositor/image", image_message(pixels, stamp, "camera"))
        bridge.watch(0.1)
    return sent


def test_images_and_answers_pass_with_the_hashes_that_it_computes(bridge_of, peer_of):
    bridge = bridge_of(COMMANDS)
    peer = peer_of("--commands", "/cmd_vel", "--speed", "0.5")
    bridge.wait_for_readers("/image_raw")
    watch(bridge, lambda: "yet" not in bridge.state[1], "the publisher")
    sent = publish_images(bridge, 20)
    watch(bridge, lambda: len(of(peer, "sha256")) >= 15, "the images")
    got = {line["stamp_ns"]: line["sha256"] for line in of(peer, "sha256")}
    assert got.items() <= sent.items()
    assert of(peer, "sha256")[0]["shape"] == [188, 336, "rgb8", 336 * 3]
    assert {line["type"]: line["hash"] for line in of(peer, "hash")} == {
        name: type_hash(name) for name in (IMAGE, TWIST)
    }
    commands = {stamp_ns(message): message.drive.speed for _, message in bridge.got}
    assert len(commands) >= 10
    assert commands.keys() <= sent.keys()
    assert set(commands.values()) == {0.5}
    # A second program that answers makes the first one worthless, too.
    peer_of("--commands", "/cmd_vel", "--speed", "0.9")
    watch(bridge, lambda: bridge.state[0] == "fault", "the fault")
    assert "2 publishers (/answering " in bridge.state[1]
    bridge.got.clear()
    publish_images(bridge, 5)
    assert bridge.got == []


def test_it_reads_every_converted_type(bridge_of, peer_of):
    bridge = bridge_of(
        {
            "send": [
                {"topic": "/vicon/car", "ros": "/pose"},
                {"topic": "/compositor/attack", "ros": "/attack", "type": ARRAY},
                {"topic": "/safety/drive", "ros": "/car_cmd", "type": TWIST},
            ]
        }
    )
    peer = peer_of("--read", f"/pose={POSE}", f"/attack={ARRAY}", f"/car_cmd={TWIST}")
    bridge.wait_for_readers("/pose", "/attack", "/car_cmd")
    now_ns = time.time_ns()
    attack = types.AttackStamp(header=make_header(now_ns), attack_id="ab12", drawn=True, reason="")
    for topic, message in (
        ("/vicon/car", pose_message(planar_pose(1.5, -2.0, 0.5), now_ns, "world")),
        ("/compositor/attack", attack),
        ("/safety/drive", drive_message(0.5, 0.2, now_ns)),
    ):
        bridge.bus.publish(topic, message)

    def got():
        return {line["topic"]: line["message"] for line in reversed(of(peer, "topic"))}  # the first of each

    watch(bridge, lambda: len(got()) == 3, "the messages")
    assert got()["/pose"]["pose"]["position"]["x"] == 1.5
    assert got()["/pose"]["header"]["frame_id"] == "world"
    values = {each["key"]: each["value"] for each in got()["/attack"]["status"][0]["values"]}
    assert values == {"attack_id": "ab12", "drawn": "true"}
    twist = got()["/car_cmd"]["twist"]
    assert twist["linear"]["x"] / twist["angular"]["z"] == pytest.approx(0.25 / np.tan(0.2), rel=1e-5)

    # The safety node of this test is silent from now on, so the car in ROS is told to stop.
    def speeds():
        commands = [line["message"] for line in of(peer, "topic") if line["topic"] == "/car_cmd"]
        return [command["twist"]["linear"]["x"] for command in commands]

    watch(bridge, lambda: len(speeds()) >= 5, "the stops")
    assert speeds()[0] == 0.5
    assert set(speeds()[1:]) == {0.0}


def test_it_finds_the_node_and_its_topics(bridge_of, peer_of):
    bridge = bridge_of(COMMANDS)
    peer = peer_of("--about", "/image_raw", "/cmd_vel")

    def found(name):
        return [line["found"] for line in of(peer, "about") if line["about"] == name and line["found"]]

    watch(bridge, lambda: found("/image_raw") and found("/cmd_vel"), "the topics")
    image, command = found("/image_raw")[-1], found("/cmd_vel")[-1]
    assert (image["publisher_count"], image["subscriber_count"]) == (1, 0)
    assert (command["publisher_count"], command["subscriber_count"]) == (0, 1)
    assert image["publishers"][0] == {
        "node_name": "advnerf",
        "node_namespace": "/",
        "topic_type": IMAGE,
        "type_hash": type_hash(IMAGE),
        "qos": "2::,5:,:,:,,",
        "gid": None,
    }
    assert (command["topic_types"], command["subscribers"][0]["qos"]) == ([TWIST], "::,10:,:,:,,")
