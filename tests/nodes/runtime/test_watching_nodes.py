import os
import re
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from nodes.launching.watching import measure_rate
from nodes.launching.watching_nodes import NodeWatch
from nodes.runtime.bus import Bus
from nodes.runtime.errors import MessageError
from nodes.runtime.messages import pose_message
from nodes.runtime.paths import RESOLVED_NAME

pytestmark = pytest.mark.live


def test_delay_of_a_topic_is_split_at_publication(tmp_path):
    stop = threading.Event()

    def publish():
        with Bus(tmp_path) as bus:
            while not stop.is_set():
                bus.publish("/vicon/car", pose_message(np.eye(4), time.time_ns() - 30_000_000))
                time.sleep(0.01)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        report = measure_rate(tmp_path, "/vicon/car", 1.0)
    finally:
        stop.set()
        thread.join()
    assert report.messages > 2
    assert 0.029 <= report.capture_to_publish.median_s < 0.3
    assert 0.0 <= report.publish_to_receive.median_s < 0.2
    assert report.capture_to_receive.median_s >= report.capture_to_publish.median_s
    with pytest.raises(MessageError, match="got 0"):
        measure_rate(tmp_path, "/vicon/board", 0.1)


RELAYING = """\
nodes: {gateway: {module: nodes.gateway, config: {imports: [/status/safety]}}, policy: {module: nodes.policy}}
"""


def test_a_node_on_another_host_is_not_said_to_have_ended_with_this_hosts_gateway(tmp_path):
    """The lock of its status belongs to the gateway, which relays it."""
    (tmp_path / RESOLVED_NAME).write_text(RELAYING)
    with NodeWatch(tmp_path) as watch:
        with Bus(tmp_path) as gateway:
            for topic in ("/status/gateway", "/status/safety"):
                gateway.publisher(topic)
            told = {row.name: (row.state, row.pid, row.text) for row in watch.rows(0.2)}
            assert re.fullmatch(r"not heard for \d+\.\d s; it runs on another host", told["safety"][2])
        told = {row.name: (row.state, row.pid, row.text) for row in watch.rows(0.2)}
    assert told["safety"] == ("silent", 0, "not known, this host's gateway has ended")
    assert told["gateway"][2].endswith("its process has ended")


@pytest.mark.slow
def test_top_shows_process_memory_rate_and_restarts(tmp_path):
    command = [sys.executable, "-m", "nodes.safety", "--folder", str(tmp_path), "--name", "safety"]
    for name in ("room", "vehicle"):
        command += ["--set", f"{name}={os.path.abspath(f'calibration/twin/{name}.yaml')}"]
    process = subprocess.Popen(command)
    try:
        with NodeWatch(tmp_path) as watch:
            deadline = time.monotonic() + 60.0
            while (
                not ((rows := watch.rows(0.5)) and rows[0].state == "ready") and time.monotonic() < deadline
            ):
                pass
            (row,) = watch.rows(1.0)
            assert (row.name, row.pid, row.restarts) == ("safety", process.pid, 0)
            assert 5.0 < row.rate_hz < 65.0  # its ticks
            assert 20 < row.memory_mib < 120
            process.send_signal(signal.SIGSTOP)
            time.sleep(0.5)  # what it sent before is taken by the first look
            watch.rows(0.5)
            (row,) = watch.rows(0.5)
            assert (row.state, row.pid, row.rate_hz) == ("silent", process.pid, 0.0)
            age_s = re.fullmatch(r"last status (\d+\.\d) s ago; its process is stopped by a signal", row.text)
            assert 0.9 <= float(age_s[1]) <= 30.0
            process.send_signal(signal.SIGCONT)
            while watch.rows(0.5)[0].state == "silent" and time.monotonic() < deadline + 60.0:
                pass
            process.kill()
            process.wait()
            watch.rows(0.5)
            (row,) = watch.rows(0.5)
            assert (row.state, row.pid) == ("silent", 0)
            assert row.text.endswith("its process has ended")
            process = subprocess.Popen(command)
            rows = []
            while not (rows and rows[0].restarts) and time.monotonic() < deadline + 60.0:
                rows = watch.rows(0.5)
            assert rows[0].restarts == 1
    finally:
        process.terminate()
        process.wait()
