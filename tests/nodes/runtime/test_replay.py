import hashlib
import importlib
import inspect
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

import nodes
from nodes.bags.info import BagMessage
from nodes.bags.reader import read_attachments, read_info, read_messages
from nodes.bags.writer import BagWriter
from nodes.replaying.lockstep import BagClock, Lockstep
from nodes.replaying.nodes import Choice
from nodes.replaying.replay import Replay, write_replay
from nodes.runtime.clock import ManualClock
from nodes.runtime.errors import BagError, MessageError, NodeFinished
from nodes.runtime.messages import decode, drive_message, encode, pose_message, stamp_ns, types
from nodes.runtime.node import Node, Out
from nodes.runtime.topics import topic as topic_row
from tests.support.messages import filled
from tests.support.replays import CORNER, GOLDEN_FOLDER, GREEN, MS, START_NS, pose, run

pytestmark = pytest.mark.live


@pytest.fixture(autouse=True)
def _green_policy_is_found(monkeypatch):
    monkeypatch.syspath_prepend(str(GOLDEN_FOLDER))


class Echo(Node):
    """Answers a pose with a command, notes every call, and commands at ticks."""

    publications = ("/policy/drive",)

    def __init__(self, tick_rate_hz=None, heard=("/vicon/car",)):
        self.tick_rate_hz, self.subscriptions, self.calls, self.infos = tick_rate_hz, heard, [], []

    def handle(self, topic, message, info, now):
        self.calls.append((topic, now.real_ns))
        self.infos.append(info)
        if topic != "/vicon/car":
            return []
        return [Out("/policy/drive", drive_message(0.5, float(message.pose.position.x), stamp_ns(message)))]

    def tick(self, now):
        self.calls.append(("tick", now.real_ns))
        return []


class Listener(Node):
    """Hears what the other one says."""

    subscriptions, publications = ("/policy/drive",), ("/safety/drive",)

    def handle(self, topic, message, info, now):
        return [Out("/safety/drive", info.raw)]


def lockstep(**nodes):
    return Lockstep(nodes, BagClock(START_NS), START_NS)


def test_an_output_reaches_the_next_node_at_the_same_time_and_keeps_the_order():
    run = lockstep(listener=Listener(), echo=Echo())
    made = run.feed(pose(7, x=0.25))
    assert [(m.topic, m.log_ns) for m in made] == [
        ("/policy/drive", START_NS + 7 * MS),
        ("/safety/drive", START_NS + 7 * MS),
    ]
    assert decode("ackermann_msgs/msg/AckermannDriveStamped", made[1].cdr).drive.steering_angle == np.float32(
        0.25
    )
    # The digest is that of topic, time, length and bytes, computed here by hand.
    expected = hashlib.sha256()
    for m in made:
        expected.update(m.topic.encode() + b"\0" + f"{m.log_ns} {len(m.cdr)}".encode() + b"\0" + m.cdr)
    assert run.finish().digest == expected.hexdigest()


def test_ticks_come_on_the_grid_of_recorded_time_between_the_messages():
    echo = Echo(tick_rate_hz=100.0)
    run = lockstep(echo=echo)
    for ms in (15, 30):
        run.advance_to(START_NS + ms * MS)
        run.feed(pose(ms))
    assert [(name, (ns - START_NS) // MS) for name, ns in echo.calls] == [
        ("tick", 0),
        ("tick", 10),
        ("/vicon/car", 15),
        ("tick", 20),
        ("tick", 30),
        ("/vicon/car", 30),
    ]


def test_gaps_and_restarts_of_a_publisher_are_told_as_the_bus_tells_them():
    echo = Echo()
    run = lockstep(echo=echo)
    for ms, sequence in ((1, 5), (2, 6), (3, 9), (4, 0), (5, 1)):
        run.feed(pose(ms, sequence))
    assert [info.lost for info in echo.infos] == [0, 0, 2, 0, 0]
    assert [info.instance_id for info in echo.infos] == [1, 1, 1, 2, 2]
    assert [info.publish_mono_ns for info in echo.infos][:2] == [START_NS, START_NS + MS]


def test_statuses_are_made_at_their_rate_and_do_not_count():
    run = lockstep(echo=Echo())
    made = run.advance_to(START_NS + 1000 * MS)
    assert [m.topic for m in made] == ["/status/echo"] * 6
    status = decode(topic_row("/status/echo").type, made[0].cdr)
    assert (status.state, status.pid, list(status.counter_names)) == ("active", 0, [])
    assert run.finish().digest == hashlib.sha256().hexdigest()


def test_bytes_that_do_not_decode_are_refused_and_the_rest_goes_on():
    run = lockstep(echo=Echo())
    assert run.feed(BagMessage("/vicon/car", b"\0\1\0\0", START_NS, START_NS, 0)) == []
    assert len(run.feed(pose(1))) == 1
    assert "expected CDR bytes of geometry_msgs/msg/PoseStamped" in run.summary.refused["/vicon/car"]


def test_a_node_that_fails_finishes_or_breaks_its_word_is_told():
    class Bad(Echo):
        def handle(self, topic, message, info, now):
            raise ZeroDivisionError("why")

    class Wrong(Echo):
        def handle(self, topic, message, info, now):
            return [Out("/safety/drive", drive_message(0, 0, 0))]

    class Done(Echo):
        def handle(self, topic, message, info, now):
            raise NodeFinished

    with pytest.raises(
        BagError, match="bad failed at 1800000000001000000 ns on /vicon/car: ZeroDivisionError: why"
    ):
        lockstep(bad=Bad()).feed(pose(1))
    with pytest.raises(MessageError, match="wrong sends /safety/drive, but declares only /policy/drive"):
        lockstep(wrong=Wrong()).feed(pose(1))
    run = lockstep(done=Done())
    assert run.feed(pose(1)) == run.feed(pose(2)) == []


def test_nodes_that_answer_each_other_for_ever_are_stopped():
    class Loop(Node):
        subscriptions = publications = ("/arm",)

        def handle(self, topic, message, info, now):
            return [Out("/arm", info.raw)]

    arm = filled(types.Arm, header=pose_message(np.eye(4), 0).header, ask_id="a")
    with pytest.raises(BagError, match="answer each other endlessly on /arm"):
        lockstep(loop=Loop()).feed(BagMessage("/arm", encode(arm), START_NS, START_NS, 0))


def test_ten_replays_have_one_digest_and_the_nodes_see_what_a_bench_by_hand_sees():
    results = [run()[1] for _ in range(10)]
    assert len({summary.digest for summary in results}) == 1
    assert results[0].made == {"/compositor/image": 12, "/compositor/attack": 12, "/policy/drive": 12}
    assert results[0].counters["compositor"]["dropped_no_pose"] == 0
    assert results[0].counters["policy"]["ticks"] == 12  # 1.182 s at 10 Hz, from the start on


def test_outputs_equal_those_of_nodes_driven_by_hand(tmp_path):
    """Second implementation: the node fed in a plain loop, without ticks that could matter."""
    from nodes.compositor import CompositorConfig, CompositorNode
    from nodes.runtime.clock import Now
    from nodes.runtime.node import MessageInfo, NodeContext

    for name, content in read_attachments(CORNER).items():
        (tmp_path / name).write_bytes(content)
    config = CompositorConfig(
        attack=tmp_path / "corner.attack.safetensors",
        camera=tmp_path / "camera.yaml",
        target=tmp_path / "board.yaml",
    )
    node = CompositorNode.build(config, NodeContext("compositor", tmp_path, ManualClock()))
    images = []
    for m in read_messages(CORNER):
        info = MessageInfo(m.publish_ns, m.log_ns, m.sequence, m.cdr)
        for out in node.handle(
            m.topic, decode(topic_row(m.topic).type, m.cdr), info, Now(m.log_ns, m.log_ns)
        ):
            if out.topic == "/compositor/image":
                images.append(out.message if isinstance(out.message, bytes) else encode(out.message))
    made, _ = run()
    assert images == [m.cdr for m in made if m.topic == "/compositor/image"]


def test_replay_written_as_a_bag_keeps_the_rest_and_is_the_same_every_time(tmp_path):
    contents = []
    for name in ("a", "b"):
        with Replay(CORNER, GREEN, whole=True) as replay:
            write_replay(replay, tmp_path / name / "out")
        contents.append((tmp_path / name / "out" / "out.mcap").read_bytes())
    assert contents[0] == contents[1]
    out = tmp_path / "a" / "out"
    counts = {topic.name: topic.count for topic in read_info(out).topics}
    assert counts["/camera/image_raw"] == 12
    assert counts["/vicon/car"] == 60
    assert counts["/policy/drive"] == 12
    assert read_attachments(out) == read_attachments(CORNER)
    kept = [m for m in read_messages(out, ["/vicon/car"])]
    assert kept == list(read_messages(CORNER, ["/vicon/car"]))
    # What it made can be replayed in turn: recorded outputs are dropped and made again.
    assert run(bag=out)[1].digest == run()[1].digest


def bag_with_launch(tmp_path, nodes, name="bag"):
    launch = yaml.safe_dump({"name": "x", "nodes": nodes}).encode()
    with BagWriter(tmp_path / name, {"launch.resolved.yaml": launch}) as writer:
        message = pose(0)
        writer.write(message.topic, message.cdr, message.log_ns, message.publish_ns, 0)
    return tmp_path / name


def test_wrong_choices_are_one_clear_error(tmp_path):
    stranger = bag_with_launch(tmp_path, {"policy": {"module": "antigravity"}})
    for choice, words in [
        (Choice(()), "expected at least one node to replay"),
        (Choice(("viewer",)), "was recorded without a node viewer; it had compositor, policy, recorder"),
        (
            Choice(("policy",), {"compositor": "x"}),
            "cannot replace compositor, which is not replayed; replayed are policy",
        ),
        (Choice(("policy",), {"policy": "no_such_thing"}), "found none called no_such_thing"),
        (Choice(("policy",), {"policy": "green_policy:Nothing"}), "name it as module:Class"),
        (Choice(("policy",), {"policy": "json"}), "expected json to have one node class"),
        (Choice(("policy",)), r"policy cannot be built for replay: .*--set policy.KEY=VALUE"),
        (Choice(("recorder",)), "recorder cannot be replayed: it opens a new bag; replayable are compositor"),
        (
            Choice(("policy",), {"policy": "green_policy"}),
            "has nothing for policy: they listen to /compositor/image",
        ),
        (Choice(GREEN.nodes, GREEN.replacements, None, ("policy.gain=1",)), "gain"),
    ]:
        with pytest.raises(Exception, match=words) as caught:
            Replay(CORNER, choice).close()
        assert type(caught.value).__module__ in ("nodes.runtime.errors", "advnerf_core.errors")
    with pytest.raises(
        BagError, match="code that is not part of advnerf; if you trust it, give --replace policy=antig"
    ):
        Replay(stranger, Choice(("policy",)))
    assert "antigravity" not in sys.modules


# Which kinds only turn messages into messages, as a person reads their build() and their constructors.
REPLAYABLE = ("calibration_drive", "collect", "compositor", "counterfactual", "expert", "policy", "safety")


def node_kinds():
    """The class of each kind of node, by the name of its module."""
    modules = [f"nodes.{file.stem}" for file in sorted(Path(nodes.__file__).parent.glob("*.py"))]
    values = [value for module in modules for value in vars(importlib.import_module(module)).values()]
    own = [value for value in values if inspect.isclass(value) and value.__module__ in modules]
    return {
        kind.__module__.rsplit(".")[-1]: kind
        for kind in own
        if issubclass(kind, Node) and "build" in vars(kind)
    }


def test_a_node_that_opens_something_is_refused_before_it_is_built(tmp_path, monkeypatch):
    kinds = node_kinds()
    assert len(kinds) >= 20
    assert sorted(kind for kind, node in kinds.items() if not node.opens) == sorted(REPLAYABLE)
    bag = bag_with_launch(tmp_path, {f"my_{kind}": {"module": f"nodes.{kind}"} for kind in kinds})
    for kind in kinds.keys() - set(REPLAYABLE):
        with pytest.raises(
            BagError, match=f"^my_{kind} cannot be replayed: it opens .*; replayable are"
        ) as told:
            Replay(bag, Choice((f"my_{kind}",)))
        named = re.findall(
            r"[a-z_]+", str(told.value).partition("replayable are ")[2].removesuffix("or your own")
        )
        assert sorted(named) == sorted(REPLAYABLE)
    with pytest.raises(BagError, match="policy cannot be replayed: it opens the motor controller"):
        Replay(CORNER, Choice(("policy",), {"policy": "nodes.motor"}))


def test_a_bag_without_a_launch_file_needs_one(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        message = pose(0)
        writer.write(message.topic, message.cdr, message.log_ns, message.publish_ns, 0)
    with pytest.raises(
        BagError, match=r"expected launch.resolved.yaml attached to .*; give the launch file with --launch"
    ):
        Replay(tmp_path / "bag", GREEN)
