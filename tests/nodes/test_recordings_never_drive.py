"""No recording drives or arms the car: every topic, in every state, played plainly, under another name, and over both bridges.

The player refuses what the topic table marks. A stranger's player does not, so the same bytes are also delivered as fresh messages:
then their capture stamps must be enough. The motor controller's firmware says what was commanded; braking is allowed.
"""

import itertools
from dataclasses import dataclass, field

import numpy as np
import pytest
from pydantic import ValidationError

from nodes.bags.writer import BagWriter
from nodes.expert import ExpertNode, ExpertNodeConfig
from nodes.linking.link import on_our_clock
from nodes.linking.ros2.routes import COMMANDS, SENSORS, TakeRoute
from nodes.linking.ros2.samples import Heard
from nodes.player import PlayerConfig, PlayerNode
from nodes.ros2 import Ros2Config, Ros2Node
from nodes.runtime.clock import Now
from nodes.runtime.errors import BagError, NodeFinished
from nodes.runtime.inbox import Inbox
from nodes.runtime.messages import (
    decode,
    drive_message,
    encode,
    pose_message,
    stamp_ns,
    type_hash_prefix,
)
from nodes.runtime.node import MessageInfo
from nodes.runtime.topics import NEVER, TOPICS, may_replay
from nodes.runtime.wire import Meta
from nodes.twin import TwinNode
from tests.support.harmful_recording import EVERY, STATUS, recorded, type_of
from tests.support.virtual_stack import (
    MS,
    REAL_NS,
    ROOM,
    STRANGER,
    VEHICLE,
    S,
    VirtualStack,
)

ERAS = {"recorded an hour ago": -3600 * S, "recorded with a clock an hour ahead": 3600 * S}
PERIOD_MS, COUNT = 40, 20
DRIVERS = ("expert", "policy")


@dataclass
class Lab:
    """The lab of the twin, of which only its car can be moved."""

    placed: list = field(default_factory=list)

    def place(self, *pose):
        self.placed.append(pose)

    def close(self):
        pass


class Bench:
    """A stack in one of the states, and the nodes that turn recorded measurements into commands."""

    def __init__(self, monkeypatch, state):
        hold = state != "armed with nobody holding" and state != "disarmed, without a hand"
        speed_mps = 0.0 if state == "armed with nobody holding" else 0.8
        self.stack = VirtualStack(monkeypatch, hold, speed_mps, DRIVERS)
        self.state, self.lab = state, Lab()
        self.twin = TwinNode(self.lab, open(VEHICLE))  # noqa: SIM115 - closed with the node
        self.expert = ExpertNode(*_expert())
        if state == "disarmed, the hand's node is missing":
            self.stack.silent.add("teleop")
        if state == "without a safety node":
            self.stack.silent.add("safety")
        self.stack.run(400)
        if state == "armed with nobody holding":
            self.stack.arm()
        if state == "armed by a hand that lets go":
            self.stack.hand = "autonomy"
        self.stack.run(200)
        assert self.stack.armed == state.startswith("armed"), self.stack.reason
        self.since_ns = self.stack.mono_ns + 1

    def say(self, topic, cdr, published_ns=None):
        """Deliver a recorded message as a fresh one."""
        message, stack = decode(type_of(topic), cdr), self.stack
        stack.say(topic, message, STRANGER, published_ns)
        info = MessageInfo(stack.mono_ns, stack.mono_ns, raw=cdr, instance_id=STRANGER)
        if topic == "/twin/reset":
            self.twin.handle(topic, message, info, stack.now)
        if topic in self.expert.subscriptions:
            for out in self.expert.handle(topic, message, info, stack.now):
                stack.say(out.topic, out.message, 8)
        if topic == "/compositor/image":  # a policy that does not look at stamps
            stack.say("/policy/drive", drive_message(0.8, 0.2, stamp_ns(message)), 5)

    def play(self, deliver):
        """Let time pass, with a message of the recording every 40 ms; the hand lets go on the way."""
        for index in range(COUNT):
            if index == COUNT // 3 and self.state == "armed by a hand that lets go":
                self.stack.hand, self.since_ns = "idle", self.stack.mono_ns + 150 * MS
            deliver(index)
            self.stack.run(PERIOD_MS)
        return self

    def verdict(self):
        """What the recording caused."""
        return self.stack.moves(self.since_ns), self.lab.placed


STATES = (
    "disarmed, without a hand",
    "disarmed, the hand's node is missing",
    "armed with nobody holding",
    "armed by a hand that lets go",
    "without a safety node",
)
NOTHING = ([], [])


def _expert():
    node = ExpertNode.build(ExpertNodeConfig(room=ROOM, vehicle=VEHICLE), None)
    return node._expert, node._config


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Every topic at 25 Hz, recorded an hour ago."""
    path = tmp_path_factory.mktemp("bag") / "bag"
    with BagWriter(path) as writer:
        for index in range(COUNT):
            at_ns = REAL_NS - 3600 * S + index * PERIOD_MS * MS
            for topic in EVERY:
                writer.write(topic, recorded(topic, index, at_ns), at_ns, at_ns, index)
    return path


def player(bag, **options):
    return PlayerNode(PlayerConfig(bag=bag, wait_for=[], **options), lambda topic: 0)


def test_the_table_names_what_must_not_be_played():
    never = {row.name for row in TOPICS.values() if row.replay == NEVER}
    assert never >= {
        "/teleop/state", "/safety/drive", "/motor/check", "/attack/switch", "/operator/act", "/twin/reset", "/expert/drive",
        "/policy/drive", "/clock/offset", "/arm", "/clock", "/safety/state", "/motor/sent",
    }  # fmt: skip
    assert not may_replay(STATUS)
    for topic in ("/camera/image_raw", "/vicon/car", "/compositor/image", "/odom", "/elsewhere"):
        assert may_replay(topic)


@pytest.mark.parametrize("topic", EVERY)
def test_the_player_obeys_the_column_of_the_source_topic(bag, topic):
    same_type = [other for other in EVERY if type_of(other) == type_of(topic)]
    if may_replay(topic):
        assert topic in player(bag).publications
        assert topic in player(bag, topics=[topic]).publications
    else:
        assert topic not in set(player(bag).publications) - {"/player/state"}
        with pytest.raises(BagError, match="a recording must not move or arm a car"):
            player(bag, topics=[topic])
    for other in same_type:
        allowed = may_replay(topic) and may_replay(other)
        for options in ({"topics": [topic]}, {}) if not allowed else ({"topics": [topic]},):
            if allowed:
                assert other in player(bag, remap={topic: other}, **options).publications
            else:
                with pytest.raises(BagError, match="a recording must not move or arm a car"):
                    player(bag, remap={topic: other}, **options)


@pytest.mark.parametrize("state", STATES)
def test_a_whole_recording_that_the_player_plays(monkeypatch, bag, state):
    bench, node = Bench(monkeypatch, state), player(bag)
    played = set()

    def deliver(index):
        try:
            for topic, cdr in node.tick(Now(bench.stack.mono_ns, bench.stack.real_ns)):
                played.add(topic)
                bench.say(topic, bytes(cdr))
        except NodeFinished:
            pass

    assert bench.play(deliver).verdict() == NOTHING
    assert played == {topic for topic in EVERY if may_replay(topic)}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("topic", EVERY)
def test_a_topic_that_a_strangers_player_plays(monkeypatch, topic, state):
    bench, offsets_ns = Bench(monkeypatch, state), tuple(ERAS.values())

    def deliver(index):
        cdr = recorded(topic, index, REAL_NS + offsets_ns[index % 2] + index * PERIOD_MS * MS)
        published_ns = None
        if index // 2 % 2:  # over a gateway: published on the other host 10 ms ago
            meta = Meta(1, bench.stack.real_ns - 10 * MS, index, type_hash_prefix(type_of(topic)), STRANGER)
            published_ns = on_our_clock(meta, bench.stack.real_ns, bench.stack.mono_ns).publish_mono_ns
        bench.say(topic, cdr, published_ns)

    assert bench.play(deliver).verdict() == NOTHING


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("era", ERAS)
def test_a_whole_recording_that_a_strangers_player_plays(monkeypatch, state, era):
    """Statuses, poses, pictures and reports support what the hand and the requests ask for."""
    bench = Bench(monkeypatch, state)
    bench.stack.silent |= {"camera", "vicon", "policy"} if state.startswith("disarmed") else set()

    def deliver(index):
        for topic in EVERY:
            bench.say(topic, recorded(topic, index, REAL_NS + ERAS[era] + index * PERIOD_MS * MS))

    assert bench.play(deliver).verdict() == NOTHING


@pytest.mark.parametrize("topic", EVERY)
def test_the_ros_2_bridge_obeys_the_column_of_the_source_topic(topic):
    """What comes in may be played, or is a command, which must answer a message that was sent a moment ago."""
    if topic in COMMANDS:
        assert TakeRoute(topic=topic, answers="/vicon/car").commands
    elif topic in SENSORS:
        assert may_replay(topic)
        assert TakeRoute(topic=topic).topic == topic
    else:
        with pytest.raises(ValidationError):
            TakeRoute(topic=topic)
    for other in EVERY:
        if topic in SENSORS and other != topic and type_of(other) == type_of(topic) and not may_replay(other):
            with pytest.raises(ValidationError, match="must not come in under another name"):
                TakeRoute(topic=topic, ros=other)


class Side:
    """The DDS end: one publisher of everything, which hears nothing."""

    def write(self, number, cdr):
        return True

    def present(self, number):
        return ("one",)

    def mismatch(self, number):
        return ""

    def rivals(self, number):
        return ()

    def readers_of(self, number):
        return 1

    def close(self):
        pass


@pytest.mark.parametrize("state", STATES)
def test_a_recording_that_comes_in_over_ros_2(monkeypatch, state):
    """`ros2 bag play` of every topic that the bridge takes, while it sends fresh poses and pictures to ROS."""
    taken = [topic for topic in (*COMMANDS, *SENSORS) if topic != "/vicon/board"]
    routes = [
        {"topic": t, "ros": "/old" + t, **({"answers": "/vicon/board"} if t in COMMANDS else {})}
        for t in taken
    ]
    config = Ros2Config.model_validate({"send": [{"topic": "/vicon/board"}], "take": routes})
    bench, inbox = Bench(monkeypatch, state), Inbox(4)
    bridge, stack = Ros2Node(config, Side(), inbox), bench.stack

    def deliver(index):
        fresh = encode(pose_message(np.eye(4), stack.real_ns - 5 * MS))
        info = MessageInfo(stack.mono_ns, stack.mono_ns, raw=fresh, publish_real_ns=stack.real_ns)
        bridge.handle("/vicon/board", None, info, stack.now)
        for era_ns, (number, topic) in itertools.product(ERAS.values(), enumerate(taken)):
            cdr = recorded(topic, index, REAL_NS + era_ns + index * PERIOD_MS * MS)
            heard = Heard(number, cdr, "one", "", ("one",), stack.real_ns, stack.mono_ns, stack.real_ns)
            for out in bridge.receive([heard], stack.now):
                assert out.topic not in COMMANDS
                bench.say(out.topic, out.message.cdr, out.message.meta.publish_mono_ns)

    assert bench.play(deliver).verdict() == NOTHING
    inbox.close()


def test_a_recorded_command_does_not_leave_over_ros_2(monkeypatch):
    config = Ros2Config.model_validate({"send": [{"topic": "/safety/drive"}]})
    stack, inbox, written = VirtualStack(monkeypatch), Inbox(4), []
    side = Side()
    side.write = lambda number, cdr: written.append(cdr) or True
    bridge = Ros2Node(config, side, inbox)
    for offset_ns in (*ERAS.values(), -S, S, 0):
        cdr = encode(drive_message(0.8, 0.0, stack.real_ns + offset_ns))
        bridge.handle("/safety/drive", None, MessageInfo(stack.mono_ns, stack.mono_ns, raw=cdr), stack.now)
    assert written == [cdr]  # that of now
    inbox.close()


def test_the_states_do_move_when_it_is_no_recording(monkeypatch):
    """The same messages with stamps of now arm and drive: the tests above can fail."""
    bench = Bench(monkeypatch, "disarmed, the hand's node is missing")
    bench.play(
        lambda index: bench.say("/teleop/state", recorded("/teleop/state", index, bench.stack.real_ns))
    )
    assert bench.verdict()[0]
    bench = Bench(monkeypatch, "disarmed, without a hand")
    bench.play(lambda index: bench.say("/arm", recorded("/arm", index, bench.stack.real_ns)))
    assert bench.verdict()[0]
    bench = Bench(monkeypatch, "disarmed, without a hand")
    bench.play(lambda index: bench.say("/motor/check", recorded("/motor/check", index, bench.stack.real_ns)))
    assert bench.verdict()[0]
    bench = Bench(monkeypatch, "without a safety node")
    both = ("/safety/state", "/safety/drive")
    bench.play(
        lambda index: [bench.say(topic, recorded(topic, index, bench.stack.real_ns)) for topic in both]
    )
    assert bench.verdict()[0]
    bench = Bench(monkeypatch, "armed with nobody holding")
    bench.play(lambda index: bench.say("/twin/reset", recorded("/twin/reset", index, bench.stack.real_ns)))
    bench.play(
        lambda index: bench.say("/expert/drive", recorded("/expert/drive", index, bench.stack.real_ns))
    )
    assert bench.verdict()[0]
    assert bench.verdict()[1]
