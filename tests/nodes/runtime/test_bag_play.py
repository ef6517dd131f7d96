"""The player told what to do: pause, step, speed, other names, a window, the clock; by the bus and by keys of a real terminal."""

import os
import pty
import re
import subprocess
import sys
import termios
import time

import numpy as np
import pytest

from nodes.bags.keys import Keys
from nodes.bags.play import PlayerCommand, Playhead
from nodes.bags.writer import BagWriter
from nodes.player import PlayerConfig, PlayerNode
from nodes.runtime.bus import Bus
from nodes.runtime.clock import ManualClock
from nodes.runtime.errors import BagError, MessageError, NodeFinished
from nodes.runtime.messages import decode, drive_message, encode, header, ns_from_stamp, pose_message, types

START_NS = 1_800_000_000_000_000_000
S = 1_000_000_000


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Two seconds of poses of the car at 50 Hz."""
    folder = tmp_path_factory.mktemp("play") / "bag"
    with BagWriter(folder) as writer:
        for i in range(100):
            t = START_NS + i * S // 50
            writer.write("/vicon/car", encode(pose_message(np.eye(4), t)), t, t, i)
        writer.write("/policy/drive", encode(drive_message(0.8, 0.1, START_NS)), START_NS + 1, START_NS, 0)
    return folder


def control(text, ask_id):
    return types.PlayerControl(header=header(0), command=text, ask_id=ask_id)


class Bench:
    """A player and a clock that only the test moves."""

    def __init__(self, bag, **config):
        config.setdefault("topics", ["/vicon/car"])
        self.node = PlayerNode(PlayerConfig(bag=bag, wait_for=[], **config), lambda topic: 1)
        self.clock, self.done, self.asks = ManualClock(7 * S, 3 * S), False, 0

    def run(self, seconds, step_s=0.005):
        outs = []
        for _ in range(round(seconds / step_s)):
            try:
                outs += self.node.tick(self.clock.now())
            except NodeFinished:
                self.done = True
                break
            self.clock.advance(step_s)
        return outs

    def tell(self, text):
        self.asks += 1
        *outs, (topic, state) = self.ask(text, f"{self.asks}")
        assert (topic, state.answered_id) == ("/player/state", f"{self.asks}")
        return outs

    def ask(self, text, ask_id):
        return self.node.handle("/player/control", control(text, ask_id), None, self.clock.now())


def test_a_topic_that_a_node_of_the_launch_publishes_is_told_in_one_line_with_that_node(bag, tmp_path):
    program = [
        sys.executable,
        "-m",
        "nodes.cli",
        "bag",
        "play",
        str(bag),
        "--no-wait",
        "--folder",
        str(tmp_path),
    ]
    with Bus(tmp_path) as node:
        node.publisher("/status/vicon")
        node.publisher("/vicon/car")
        done = subprocess.run(program, capture_output=True, text=True, timeout=600)
        assert done.returncode == 1
        assert done.stderr == (
            f"bag_play: /vicon/car is already published in {tmp_path} by the node vicon (process {os.getpid()}). Leave the topic out here "
            "(bag play: --topics, --remap), start the launch without that node (--set vicon.if=false), or use another --folder\n"
        )
        assert not (tmp_path / "logs").exists()
        again = [*program, "--rate", "100", "--remap", "/vicon/car:=/vicon/board"]
        assert subprocess.run(again, timeout=600).returncode == 0


def test_pause_holds_the_recording_and_resume_goes_on_where_it_was(bag):
    bench = Bench(bag)
    assert len(bench.run(0.5)) == 25
    bench.tell("pause")
    assert bench.run(5.0) == []
    assert "paused" in bench.node.status()[1]
    bench.tell("resume")
    assert len(bench.run(10.0)) == 75
    assert bench.done


def test_steps_are_exact_and_leave_it_paused(bag):
    bench = Bench(bag, paused=True)
    assert bench.run(1.0) == []
    assert len(bench.tell("step")) == 1
    assert len(bench.tell("step 10")) == 10
    assert bench.run(1.0) == []
    bench.tell("toggle")
    # The eleventh message is at 0.2 s; those at 0.22, 0.24, 0.26 and 0.28 s are due at the ticks up to 0.295 s.
    assert len(bench.run(0.1)) == 4
    assert len(bench.tell("step 1000")) == 85


def test_a_repeated_request_steps_once_and_is_answered_again(bag):
    bench = Bench(bag, paused=True)
    bench.run(0.1)
    first, again, other = bench.ask("step 3", "a"), bench.ask("step 3", "a"), bench.ask("step 3", "b")
    assert [len(outs) for outs in (first, again, other)] == [4, 1, 4]
    assert (first[-1].message.answer, first[-1].message.granted) == ("3 messages played; paused", True)
    assert again[-1].message.answer == first[-1].message.answer
    assert [len(bench.ask("nonsense", "c")), bench.ask("nonsense", "c")[-1].message.granted] == [1, False]


def test_rate_changes_on_the_way(bag):
    bench = Bench(bag)
    assert len(bench.run(0.5)) == 25
    bench.tell("rate 4")
    assert len(bench.run(0.25)) == 50
    bench.node.receive("slower", bench.clock.now())
    assert bench.node._head.rate == pytest.approx(3.2)


def test_a_window_and_another_name(bag):
    bench = Bench(bag, start_offset_s=0.5, duration_s=0.3, remap={"/vicon/car": "/vicon/board"})
    assert bench.node.publications == ("/vicon/board", "/player/state")
    outs = bench.run(5.0)
    assert bench.done
    stamps = [
        ns_from_stamp(decode("geometry_msgs/msg/PoseStamped", out.message).header.stamp) for out in outs
    ]
    assert {out.topic for out in outs} == {"/vicon/board"}
    assert (min(stamps) - START_NS, max(stamps) - START_NS) == (S // 2, 8 * S // 10)


def test_clock_tells_recorded_time_also_while_it_stands(bag):
    bench = Bench(bag, rate=2.0, clock_hz=50.0)
    outs = bench.run(0.5)
    times = [(ns_from_stamp(out.message.clock) - START_NS) / S for out in outs if out.topic == "/clock"]
    assert len(times) == 25
    np.testing.assert_allclose(times, np.arange(25) * 0.04, atol=1e-9)
    bench.tell("pause")
    standing = {ns_from_stamp(out.message.clock) for out in bench.run(0.5) if out.topic == "/clock"}
    assert len(standing) == 1
    clock, pose = bench.tell("step")
    assert clock.topic == "/clock"
    assert ns_from_stamp(clock.message.clock) == ns_from_stamp(
        decode("geometry_msgs/msg/PoseStamped", pose.message).header.stamp
    )


def test_stop_ends_it_even_while_it_waits(bag):
    node = PlayerNode(PlayerConfig(bag=bag), lambda topic: 0)
    clock = ManualClock()
    assert node.tick(clock.now()) == []
    (pause,) = node.handle("/player/control", control("pause", "1"), None, clock.now())
    assert (pause.message.granted, pause.message.answer) == (False, "playback has not started yet")
    (stop,) = node.handle("/player/control", control("stop", "2"), None, clock.now())
    assert stop.message.granted
    clock.advance(0.2)
    assert node.tick(clock.now()) == []  # who asked may not have heard the answer
    (again,) = node.handle("/player/control", control("stop", "2"), None, clock.now())
    assert (again.message.answered_id, again.message.granted) == ("2", True)
    clock.advance(0.06)
    with pytest.raises(NodeFinished):
        node.tick(clock.now())


@pytest.mark.parametrize(
    "text", ["", "go", "step x", "step 0", "step 1.5", "rate", "rate 0", "rate nan", "pause now", "a" * 999]
)
def test_texts_that_mean_nothing_change_nothing(bag, text):
    with pytest.raises(MessageError, match="expected pause, resume"):
        PlayerCommand.parse(text)
    bench = Bench(bag)
    bench.run(0.1)
    assert bench.tell(text) == []
    assert "expected pause" in bench.node.status()[1]
    assert len(bench.run(5.0)) == 95


def test_names_that_cannot_be_are_refused(bag):
    for remap, words in [
        ({"/arm": "/vicon/car"}, "/arm is not played; played are /vicon/car"),
        (
            {"/vicon/car": "/odom"},
            "/vicon/car is geometry_msgs/msg/PoseStamped, expected nav_msgs",
        ),
    ]:
        with pytest.raises(BagError, match=words):
            Bench(bag, remap=remap)
    with pytest.raises(BagError, match=r"has no message of /vicon/car after 0\.001 s within 0\.001 s"):
        Bench(bag, start_offset_s=0.001, duration_s=0.001).run(0.1)


def test_playhead_against_the_sum_of_its_pieces():
    head, expected, mono = Playhead(1000, 0, rate=1.5), 1000.0, 0
    rng = np.random.default_rng(3)
    for _ in range(200):
        step = int(rng.integers(1, 10**9))
        expected += 0.0 if head.paused else step * head.rate
        mono += step
        assert head.time_ns(mono) == pytest.approx(expected, abs=200)
        if rng.random() < 0.5:
            head.pause(bool(rng.random() < 0.5), mono)
        else:
            head.set_rate(float(rng.uniform(0.1, 10)), mono)


def test_keys_of_a_terminal_are_read_and_the_terminal_is_given_back():
    master, slave = pty.openpty()
    before = termios.tcgetattr(slave)
    keys = Keys(slave)
    try:
        assert not termios.tcgetattr(slave)[3] & termios.ICANON
        words = []
        for typed in (b" ", b"\x1b[C", b"s", b"+", b"-", b"x", b"q"):
            os.write(master, typed)
            words.append(keys.read())
        assert words == ["toggle", "step", "step", "faster", "slower", None, "stop"]
        assert keys.read() is None
    finally:
        keys.close()
        assert termios.tcgetattr(slave) == before
        os.close(master)
        os.close(slave)


def test_command_plays_under_a_terminal_and_obeys_keys_and_bus(bag, tmp_path):
    """A real process on a real terminal: it stands, steps at a key, goes on at a word from the bus, ends at a key."""
    master, slave = pty.openpty()
    command = [
        sys.executable,
        "-m",
        "nodes.cli",
        "bag",
        "play",
        str(bag),
        "--paused",
        "--loop",
        "--folder",
        str(tmp_path),
    ]

    def control_says(*words):
        program = [sys.executable, "-m", "nodes.cli", "bag", "control", *words, "--folder", str(tmp_path)]
        return subprocess.run(program, capture_output=True, text=True, timeout=600, check=False)

    with Bus(tmp_path) as bus:
        bus.subscribe("/vicon/car", queue=500)
        process = subprocess.Popen(
            [*command, "--topics", "/vicon/car"], stdin=slave, stdout=subprocess.PIPE, text=True
        )

        def hear(wanted, limit_s=60.0):
            got, deadline = [], time.monotonic() + limit_s
            while len(got) < wanted and time.monotonic() < deadline:
                bus.wait(0.05)
                got += bus.receive()
            return got

        try:
            assert "space: pause" in process.stdout.readline()
            with Bus(tmp_path) as recorder:
                recorder.subscribe("/player/control")  # its only subscriber may be a recorder
                deadline = time.monotonic() + 60.0
                while control_says("rate 1").returncode and time.monotonic() < deadline:
                    pass
            assert hear(1, 0.5) == []
            os.write(master, b"s")
            assert [received.info.sequence for received in hear(1)] == [0]
            stepped = control_says("step", "3")
            assert (stepped.returncode, stepped.stdout) == (0, "4 messages played; paused\n")
            assert len(hear(3)) == 3
            assert hear(1, 0.3) == []
            os.write(master, b" ")
            assert len(hear(20)) >= 20
            os.write(master, b"q")
            assert process.wait(120) == 0
        finally:
            process.kill()
            process.wait()
            process.stdout.close()
            os.close(master)
            os.close(slave)
    wrong = control_says("jump")
    assert wrong.returncode == 2
    assert re.match(r"error: expected pause, resume", wrong.stderr)
    absent = control_says("pause")
    assert absent.returncode == 2
    assert "expected an answer from a player within 3 s, got none" in absent.stderr
