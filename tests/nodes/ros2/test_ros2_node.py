"""The ROS 2 node without sockets: what it passes on, what it refuses, and that it stops a car in ROS."""

import math

import numpy as np
import pytest

from advnerf_core.geometry import planar_pose
from nodes.linking.ros2.samples import Heard
from nodes.ros2 import Ros2Config, Ros2Node
from nodes.runtime.clock import Now
from nodes.runtime.inbox import Inbox
from nodes.runtime.messages import (
    decode,
    drive_message,
    encode,
    header,
    image_message,
    pose_message,
    type_hash,
    types,
)
from nodes.runtime.node import MessageInfo
from nodes.runtime.wire import Relayed

S, MS = 10**9, 10**6
REAL = 1_795_000_000 * S
ACKERMANN, TWIST = "ackermann_msgs/msg/AckermannDriveStamped", "geometry_msgs/msg/TwistStamped"
PIXELS = np.random.default_rng(0).integers(0, 256, (188, 336, 3), dtype=np.uint8)
CONFIG = {
    "vehicle": "vehicle.yaml",
    "send": [
        {"topic": "/compositor/image", "ros": "/image_raw"},
        {"topic": "/vicon/car", "ros": "/tf", "type": "tf2_msgs/msg/TFMessage", "rate_hz": 20.0},
        {"topic": "/vicon/car", "ros": "/pose"},
        {"topic": "/safety/drive", "ros": "/ackermann_cmd"},
        {"topic": "/safety/drive", "ros": "/twist_cmd", "type": TWIST},
    ],
    "take": [
        {"topic": "/policy/drive", "ros": "/cmd", "type": TWIST, "answers": "/compositor/image"},
        {"topic": "/expert/drive", "ros": "/cmd2", "answers": "/vicon/car"},
        {"topic": "/odom"},
    ],
}


class Recorded:
    """The DDS end as a list; it is not a stand-in for DDS, whose tests are in test_dds.py."""

    def __init__(self):
        self.written, self.publishers, self.full, self.closed, self.wrong = [], {}, False, False, ""
        self.others = {}

    def write(self, number, cdr):
        self.written.append((number, bytes(cdr)))
        return not self.full

    def present(self, number):
        return self.publishers.get(number, ("one",))

    def mismatch(self, number):
        return self.wrong

    def rivals(self, number):
        assert number in (0, 1, 2)  # the topics that commands answer
        return self.others.get(number, ())

    def readers_of(self, number):
        return 1

    def close(self):
        self.closed = True


@pytest.fixture
def side():
    return Recorded()


@pytest.fixture
def node(side):
    inbox = Inbox(4)
    yield Ros2Node(Ros2Config.model_validate(CONFIG), side, inbox, wheelbase_m=0.25)
    inbox.close()


def now(mono_ns):
    return Now(mono_ns=mono_ns, real_ns=REAL + mono_ns)


def send(node, topic, message, mono_ns, published_ns=None):
    info = MessageInfo(mono_ns if published_ns is None else published_ns, mono_ns, raw=encode(message))
    assert node.handle(topic, None, info, now(mono_ns)) == []


def heard(message, mono_ns, reader=0, writer="one", present=("one",), stated="", source_ns=None, cdr=None):
    source = REAL + (mono_ns if source_ns is None else source_ns)
    cdr = encode(message) if cdr is None else cdr
    return Heard(reader, cdr, writer, stated, present, source, mono_ns, REAL + mono_ns)


def twist(stamp_ns, speed=0.8, yaw=0.0):
    linear, angular = types.Vector3(x=speed, y=0.0, z=0.0), types.Vector3(x=0.0, y=0.0, z=yaw)
    return types.TwistStamped(header=header(stamp_ns), twist=types.Twist(linear=linear, angular=angular))


def image(stamp_ns):
    return image_message(PIXELS, stamp_ns, "camera")


def test_bytes_pass_through_and_types_are_converted(node, side):
    message = image(REAL)
    send(node, "/compositor/image", message, S)
    assert side.written == [(0, encode(message))]
    send(node, "/vicon/car", pose_message(planar_pose(1.0, 2.0, 0.0), REAL), S)
    assert [number for number, _ in side.written] == [0, 1, 2]
    assert decode("tf2_msgs/msg/TFMessage", side.written[1][1]).transforms[0].transform.translation.x == 1.0


def test_rates_are_limited_and_late_messages_stay(node, side):
    for k in range(20):
        send(node, "/vicon/car", pose_message(planar_pose(1.0, 2.0, 0.0), REAL + k), S + k * 10 * MS)
    assert [number for number, _ in side.written].count(2) == 20
    assert [number for number, _ in side.written].count(1) in (4, 5)
    send(node, "/compositor/image", image(REAL), 3 * S, published_ns=2 * S)
    assert 0 not in [number for number, _ in side.written]
    assert node.counters()["stale /compositor/image"] == 1


def test_an_answer_becomes_a_command_with_the_stamp_of_its_image(node):
    send(node, "/compositor/image", image(REAL), S)
    yaw = 0.8 * math.tan(0.2) / 0.25
    (out,) = node.receive(
        [heard(twist(REAL, 0.8, yaw), S + 20 * MS, source_ns=S + 15 * MS)], now(S + 21 * MS)
    )
    assert out.topic == "/policy/drive"
    assert isinstance(out.message, Relayed)
    command = decode(ACKERMANN, out.message.cdr)
    assert (command.drive.speed, command.drive.steering_angle) == pytest.approx((0.8, 0.2))
    assert command.header.stamp == header(REAL).stamp
    # Five milliseconds on the way, by the clock of this computer.
    assert out.message.meta.publish_mono_ns == S + 15 * MS
    assert node.status()[0] == "ready"  # the other two routes are silent
    assert node.counters()["taken /policy/drive"] == 1


def test_commands_from_another_computer_are_as_old_as_their_arrival(side):
    inbox = Inbox(4)
    node = Ros2Node(Ros2Config.model_validate(CONFIG), side, inbox, 0.25, on_this_host=False)
    send(node, "/compositor/image", image(REAL), S)
    (out,) = node.receive([heard(twist(REAL), S + 20 * MS, source_ns=900 * S)], now(S + 21 * MS))
    assert out.message.meta.publish_mono_ns == S + 20 * MS
    inbox.close()


def test_a_publisher_cannot_make_its_command_younger_than_its_arrival(node):
    send(node, "/compositor/image", image(REAL), S)
    (out,) = node.receive([heard(twist(REAL), S + 20 * MS, source_ns=900 * S)], now(S + 21 * MS))
    assert out.message.meta.publish_mono_ns == S + 20 * MS


@pytest.mark.parametrize(
    "wrong",
    [
        {"message": twist(REAL + 1)},
        {"message": twist(0)},
        {"message": twist(REAL), "mono_ns": S + 200 * MS},
        {"message": twist(REAL), "writer": "two"},
        {"message": twist(REAL), "present": ("one", "two")},
        {"message": twist(REAL), "stated": "RIHS01_" + "0" * 64},
        {"message": twist(REAL), "cdr": encode(twist(REAL))[:-8]},
        {"message": twist(REAL), "cdr": encode(twist(REAL)) + bytes(64)},
        {"message": twist(REAL), "cdr": b"\x00\x07" + encode(twist(REAL))[2:]},
        {"message": twist(REAL), "cdr": b""},
        {"message": twist(REAL), "cdr": encode(twist(REAL))[:12] + b"\xff" * 60},
        {"message": twist(REAL), "cdr": encode(image(REAL))},
        {"message": twist(REAL), "reader": 1},
    ],
)
def test_what_does_not_count_is_refused_and_counted(node, wrong):
    send(node, "/compositor/image", image(REAL), S)
    item = heard(**{"mono_ns": S + 20 * MS, **wrong})
    assert node.receive([item], now(item.mono_ns)) == []
    assert sum(count for name, count in node.counters().items() if name.startswith("refused")) == 1
    (out,) = node.receive([heard(twist(REAL), S + 30 * MS)], now(S + 30 * MS))
    assert out.topic == "/policy/drive"


def test_values_are_the_business_of_the_safety_node(node):
    send(node, "/compositor/image", image(REAL), S)
    (out,) = node.receive([heard(twist(REAL, math.nan), S + MS)], now(S + MS))
    assert math.isnan(decode(ACKERMANN, out.message.cdr).drive.speed)


def test_a_right_hash_of_the_type_is_accepted(node):
    send(node, "/compositor/image", image(REAL), S)
    assert node.receive([heard(twist(REAL), S + MS, stated=type_hash(TWIST))], now(S + MS))


def test_a_flood_gives_one_command_for_each_image(node):
    send(node, "/compositor/image", image(REAL), S)
    flood = [heard(twist(REAL), S + MS) for _ in range(500)]
    assert len(node.receive(flood, now(S + MS))) == 1


def test_another_publisher_is_another_instance(node):
    instances = set()
    for k, writer in enumerate(("one", "one", "two")):
        send(node, "/compositor/image", image(REAL + k), S + k * MS)
        (out,) = node.receive(
            [heard(twist(REAL + k), S + k * MS, writer=writer, present=(writer,))], now(S + k * MS)
        )
        instances.add(out.message.meta.instance_id)
    assert len(instances) == 2


def test_two_publishers_are_a_fault_even_if_one_is_silent(node, side):
    assert node.tick(now(S)) == []
    assert node.status()[0] != "fault"
    side.publishers[0] = ("one", "two")
    node.tick(now(2 * S))
    state, text = node.status()
    assert state == "fault"
    assert "/cmd: 2 publishers (one, two)" in text


def test_another_publisher_of_what_is_answered_is_a_fault(node, side):
    send(node, "/compositor/image", image(REAL), S)
    side.others[0] = ("liar",)
    node.tick(now(S))
    assert node.status()[0] == "fault"
    assert "somebody else publishes what it answers (/compositor/image): liar" in node.status()[1]
    assert node.receive([heard(twist(REAL), S + MS)], now(S + MS)) == []
    side.others.clear()
    node.tick(now(S + 2 * MS))
    assert node.receive([heard(twist(REAL), S + 3 * MS)], now(S + 3 * MS))


def test_silence_is_explained(node, side):
    side.publishers[0] = ()
    node.tick(now(S))
    assert node.status() == ("ready", f"no publisher of /cmd ({TWIST}) yet")
    side.wrong = "a publisher of /cmd does not offer reliable delivery"
    node.tick(now(S))
    assert node.status() == ("ready", side.wrong)


def drives(side, since):
    return [decode(ACKERMANN, cdr).drive.speed for number, cdr in side.written[since:] if number == 3]


def test_a_car_in_ros_is_stopped_when_the_safety_node_falls_silent(node, side):
    send(node, "/safety/drive", drive_message(0.5, 0.1, REAL + S), S)
    node.tick(now(S + 200 * MS))
    assert drives(side, 0) == pytest.approx([0.5])
    node.tick(now(S + 300 * MS))
    assert drives(side, 1) == [0.0]
    for k in range(100):
        node.tick(now(S + 350 * MS + k * 50 * MS))
    assert drives(side, 1) == [0.0] * 20
    assert decode(TWIST, next(cdr for number, cdr in side.written[-2:] if number == 4)).twist.linear.x == 0.0


def test_a_car_in_ros_is_stopped_when_the_node_ends(node, side):
    send(node, "/safety/drive", drive_message(0.5, 0.1, REAL + S), S)
    node.close()
    assert drives(side, 0) == pytest.approx([0.5, 0.0])
    assert side.closed


def test_a_stopped_car_is_left_alone(node, side):
    send(node, "/safety/drive", drive_message(0.5, 0.1, REAL + S), S)
    send(node, "/safety/drive", drive_message(0.0, 0.0, REAL + S + MS), S + MS)
    node.tick(now(5 * S))
    node.close()
    assert drives(side, 0) == pytest.approx([0.5, 0.0])


def test_a_full_queue_is_counted(node, side):
    side.full = True
    send(node, "/compositor/image", image(REAL), S)
    assert node.counters()["full /compositor/image"] == 1
    assert "sent /compositor/image" not in node.counters()


def test_a_command_may_answer_a_pose(node):
    send(node, "/vicon/car", pose_message(planar_pose(0.0, 0.0, 0.0), REAL + 5), S)
    (out,) = node.receive([heard(drive_message(0.4, 0.0, REAL + 5), S + MS, reader=1)], now(S + MS))
    assert out.topic == "/expert/drive"
    assert out.message.cdr == encode(drive_message(0.4, 0.0, REAL + 5))
