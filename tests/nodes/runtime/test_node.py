import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest

from advnerf_core.plugins import PluginError
from nodes.runtime.bus import Bus
from nodes.runtime.errors import NodeFinished
from nodes.runtime.loop import Schedule
from nodes.runtime.messages import drive_message, image_message
from nodes.runtime.messages import stamp_ns as stamp_of
from nodes.runtime.node import Inbox, Node, Out, ReaderThread
from nodes.runtime.process import run_node
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live


def test_schedule_stays_on_its_grid_and_skips_what_it_missed():
    schedule = Schedule(rate_hz=10.0, start_ns=0)
    assert schedule.due(0)
    assert not schedule.due(99_999_999)
    assert schedule.due(100_000_001)
    assert schedule.next_ns == 200_000_000
    # A stall of 250 ms misses the ticks at 300 and 400 ms and makes one late one.
    assert schedule.due(450_000_000)
    assert not schedule.due(450_000_001)
    assert schedule.next_ns == 500_000_000
    assert (schedule.done, schedule.missed) == (3, 2)
    assert schedule.worst_lag_s == pytest.approx(0.25)


def test_inbox_keeps_the_newest_counts_the_rest_and_passes_failures_on():
    inbox = Inbox(capacity=2)
    for i in range(5):
        inbox.put(i)
    assert inbox.take() == [3, 4]
    assert inbox.dropped == 3
    assert inbox.take() == []
    inbox.fail(OSError("cable"))
    with pytest.raises(OSError, match="cable"):
        inbox.take()
    inbox.close()
    inbox.put(1)


def test_reader_thread_brings_items_and_failures():
    inbox, items = Inbox(capacity=10), [1, None, 2]

    def read():
        if not items:
            raise OSError("unplugged")
        return items.pop(0)

    thread = ReaderThread(read, inbox, "reader")
    thread.start()
    thread._thread.join(60)
    with pytest.raises(OSError, match="unplugged"):
        inbox.take()


def test_a_reader_whose_driver_calls_exit_does_not_end_without_a_word():
    """A thread that raises SystemExit ends silently, and its node would wait for data for ever."""
    inbox = Inbox(capacity=1)
    thread = ReaderThread(sys.exit, inbox, "reader")
    thread.start()
    thread._thread.join(60)
    with pytest.raises(PluginError, match=r"has called sys\.exit"):
        inbox.take()


class Echo(Node):
    """Answers every image with a drive command of the same stamp."""

    subscriptions = ("/camera/image_raw",)
    publications = ("/policy/drive",)
    tick_rate_hz = 50.0

    def __init__(self):
        self.ticks = 0
        self.closed = False
        self.writeable = None

    def handle(self, topic, message, info, now):
        self.writeable = message.data.flags.writeable
        return [Out("/policy/drive", drive_message(0.5, 0.0, stamp_of(message)))]

    def tick(self, now):
        self.ticks += 1
        return []

    def counters(self):
        return {"own": 7.0}

    def close(self):
        self.closed = True


class Running:
    """A node loop in a thread."""

    def __init__(self, node, run_dir, name="echo"):
        self.loop, ready = None, threading.Event()

        def on_loop(loop):
            self.loop = loop
            ready.set()

        def run():
            self.exit_code = run_node(lambda context: node, name, run_dir, on_loop=on_loop)
            ready.set()

        self.thread = threading.Thread(target=run)
        self.thread.start()
        assert ready.wait(60)

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.loop.stop()
        self.thread.join(60)
        assert not self.thread.is_alive()


def hear(bus, topic, accept=lambda message: True):
    def heard():
        bus.wait(0.05)
        return next((r for r in bus.receive() if r.topic == topic and accept(r.message())), None)

    return wait_for(heard, f"a message on {topic}")


def test_node_answers_messages_ticks_and_tells_its_status(tmp_path):
    node = Echo()
    with Bus(tmp_path) as bus, Running(node, tmp_path) as running:
        bus.subscribe("/policy/drive")
        bus.subscribe("/status/echo")
        bus.publisher("/camera/image_raw")
        bus.wait_for_subscribers(["/camera/image_raw"], 60)
        bus.publish("/camera/image_raw", image_message(np.zeros((2, 3, 3), np.uint8), 42, "cam"))
        assert stamp_of(hear(bus, "/policy/drive").message()) == 42
        status = hear(
            bus, "/status/echo", accept=lambda m: m.state == "active" and m.subscribers[0] == 1
        ).message()
        assert status.pid == os.getpid()
        assert list(status.publications) == ["/policy/drive"]
        counters = dict(zip(status.counter_names, status.counter_values, strict=True))
        assert counters["own"] == 7
        assert counters["received /camera/image_raw"] == 1
        start, first = time.monotonic(), node.ticks
        wait_for(lambda: node.ticks >= first + 25, "ticks")
        assert 25 / (time.monotonic() - start) < 60, "50 a second, or fewer on a busy machine"
    assert running.exit_code == 0
    assert node.closed
    assert node.writeable is False


class Breakable(Echo):
    """In fault when the test says so."""

    broken = False

    def status(self):
        return ("fault", "broken") if self.broken else ("active", "")

    def counters(self):
        return {"ticks": self.ticks}


def test_a_change_of_state_is_told_at_once(tmp_path):
    node = Breakable()
    with Bus(tmp_path) as bus, Running(node, tmp_path):
        bus.subscribe("/status/echo")
        hear(bus, "/status/echo")
        before, node.broken = node.ticks, True
        told = hear(bus, "/status/echo", accept=lambda m: m.state == "fault").message()
    ticks = dict(zip(told.counter_names, told.counter_values, strict=True))["ticks"]
    assert ticks - before <= 3, "its turn comes every ten ticks"


class FromThread(Node):
    """Publishes what a driver thread brings."""

    publications = ("/camera/image_raw",)

    def __init__(self):
        self.inbox = Inbox()

    def handle(self, topic, message, info, now):
        raise AssertionError("subscribes to nothing")

    def receive(self, item, now):
        return [Out("/camera/image_raw", image_message(item, now.real_ns, "cam"))]


def test_item_of_a_driver_thread_is_published_at_once(tmp_path):
    node = FromThread()
    with Bus(tmp_path) as bus, Running(node, tmp_path):
        bus.subscribe("/camera/image_raw")
        delays = []
        for i in range(30):
            put_ns = time.monotonic_ns()
            node.inbox.put(np.zeros((2, 2, 3), np.uint8))
            bus.wait(0.1)
            if (got := bus.receive()) and i > 5:
                delays.append((got[0].info.publish_mono_ns - put_ns) / 1e6)
            time.sleep(0.005)
        assert np.median(delays) < 50.0  # a node that is not woken looks every 200 ms


class Failing(Echo):
    def tick(self, now):
        if self.ticks == 3:
            raise ValueError("expected a good day,\n got none")
        return super().tick(now)


def test_exception_closes_the_node_reports_a_fault_and_ends_with_an_error_code(tmp_path, capsys):
    node = Failing()
    with Bus(tmp_path) as bus:
        bus.subscribe("/status/echo")
        with Running(node, tmp_path) as running:
            status = hear(bus, "/status/echo", accept=lambda m: m.state == "fault").message()
        assert "got none" in status.text
    assert running.exit_code == 1
    assert node.closed
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith("echo: ValueError: expected a good day, got none (traceback in ")
    assert "Traceback" in (tmp_path / "logs" / "echo.traceback.txt").read_text()


class Finishing(Echo):
    def tick(self, now):
        raise NodeFinished


def test_finished_node_ends_well(tmp_path):
    with Running(Finishing(), tmp_path) as running:
        running.thread.join(60)
    assert running.exit_code == 0


class Undeclared(Echo):
    def tick(self, now):
        return [Out("/arm", drive_message(0, 0, 0))]


def test_undeclared_publication_is_a_fault(tmp_path, capsys):
    with Running(Undeclared(), tmp_path) as running:
        running.thread.join(60)
    assert running.exit_code == 1
    assert "sends /arm, but declares only /policy/drive" in capsys.readouterr().err


def test_second_node_of_a_name_ends_before_it_opens_its_device(tmp_path, capsys):
    with Running(Echo(), tmp_path):
        built = []
        assert run_node(lambda context: built.append(context), "echo", tmp_path) == 1
        assert built == []
    assert (
        f"expected one node echo in {tmp_path}, got another one beside process {os.getpid()}; end that one"
        in capsys.readouterr().err
    )


NODE_SCRIPT = """
    from pydantic import BaseModel, ConfigDict
    from nodes.runtime.node import Node
    from nodes.runtime.process import run_node_main

    class CounterConfig(BaseModel):
        model_config = ConfigDict(extra="forbid")
        rate_hz: float = 20.0

    class CounterNode(Node):
        @classmethod
        def build(cls, config, context):
            node = cls()
            node.tick_rate_hz = config.rate_hz
            return node
        def handle(self, topic, message, info, now):
            return []
        def close(self):
            print("closed", flush=True)

    raise SystemExit(run_node_main(CounterConfig, CounterNode.build))
"""


@pytest.fixture
def script(tmp_path):
    path = tmp_path / "counter.py"
    path.write_text(textwrap.dedent(NODE_SCRIPT))
    return path


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_signal_ends_a_process_cleanly(script, tmp_path, number):
    with Bus(tmp_path) as bus:
        bus.subscribe("/status/counter")
        process = subprocess.Popen(
            [sys.executable, script, "--folder", tmp_path],
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),  # the tests may run under nohup
        )
        hear(bus, "/status/counter", accept=lambda m: m.state == "active")
        process.send_signal(number)
        output, _ = process.communicate(timeout=600)
    assert process.returncode == 0
    assert output == "closed\n"


def test_wrong_config_is_one_line_with_file_line_and_valid_keys(script, tmp_path):
    config = tmp_path / "counter.yaml"
    config.write_text("# comment\nrate: 5\n")
    command = [sys.executable, script, "--folder", tmp_path, "--config", config]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 2
    assert result.stderr == f"counter: {config}:2: unknown key rate; valid keys here: rate_hz\n"
