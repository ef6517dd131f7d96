"""``advnerf car page BAG``: a recording on the page, in real processes, without a car."""

import os
import re
import signal
import subprocess
import sys
import time
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("uvicorn")
pytest.importorskip("websockets")

from nodes.bags.writer import BagWriter
from nodes.runtime.messages import encode, image_message, pose_message
from tests.support.bag_samples import START_NS, sample
from tests.support.live.page_client import Browser
from tests.support.page import REPOSITORY, TWIN

pytestmark = pytest.mark.live


@pytest.fixture
def bag(tmp_path):
    """Two seconds of a car that drives along x, its camera, a request to arm and the room."""
    with BagWriter(tmp_path / "bag", {"room.yaml": (TWIN / "room.yaml").read_bytes()}) as writer:
        writer.write("/arm", sample("advnerf_msgs/msg/Arm", START_NS), START_NS, START_NS, 0)
        for i in range(40):
            t, T_world_from_car = START_NS + i * 50_000_000, np.eye(4)
            T_world_from_car[0, 3] = 0.01 * i
            writer.write("/vicon/car", encode(pose_message(T_world_from_car, t)), t, t, i)
            for topic in ("/camera/image_raw", "/compositor/image"):
                rgb = np.full((94, 168, 3), 5 * i, np.uint8)
                writer.write(topic, encode(image_message(rgb, t, "camera")), t, t, i)
    return tmp_path / "bag"


def address(process, log):
    for _ in range(300):
        if found := re.search(r"http://127\.0\.0\.1:(\d+)/ shows", log.read_text()):
            return int(found.group(1))
        assert process.poll() is None, log.read_text()
        time.sleep(0.1)
    raise AssertionError(log.read_text())


def test_a_recording_plays_again_and_again_and_nobody_can_drive(bag, tmp_path):
    log, run_dir = tmp_path / "log", tmp_path / "run"
    command = [
        sys.executable,
        "-m",
        "nodes.cli",
        "car",
        "page",
        str(bag),
        "--port",
        "0",
        "--rate",
        "4",
        "--folder",
        str(run_dir),
    ]
    with log.open("wb") as said:
        process = subprocess.Popen(command, cwd=REPOSITORY, stdout=said, stderr=said, env={**os.environ})
    browser = None
    try:
        browser = Browser(address(process, log))
        assert browser.welcome["operates"] is False
        assert browser.welcome["path"]  # of the room in the bag
        browser.wait(lambda: len({channel for channel, _, _ in browser.pictures}) == 2, "both pictures")
        seen = []
        for _ in range(60):  # three seconds: the recording lasts half a second at this rate
            seen.append(browser.state["car"]["x_m"] if browser.state["car"] else 0.0)
            time.sleep(0.05)
        assert 0.0 <= min(seen) < 0.15 < max(seen) < 0.4
        assert any(later < earlier for earlier, later in pairwise(seen)), "it did not begin again"
        assert "only watches" in browser.do("take", name="Ann")
        for stop in ("estop", "disarm"):
            assert browser.do(stop) == "this page shows a recording, which has no car to stop"
        assert "only watches" in browser.do("take", name="Ann"), "the page is still here"
    finally:
        if browser is not None:
            browser.close()
        process.send_signal(signal.SIGINT)
        process.wait(120)
    assert process.returncode == 0, log.read_text()
