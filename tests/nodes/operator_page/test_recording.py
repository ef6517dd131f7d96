"""What the page says about its recorder, with a real one."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nodes.bags.reader import read_info
from nodes.operator_page.recording import RECORDER, RecorderControl
from nodes.runtime.errors import BagError
from nodes.runtime.messages import types
from tests.support.messages import filled
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live
ROOT = Path(__file__).parents[3]


def status(pid, received):
    return filled(
        types.NodeStatus,
        node=RECORDER,
        pid=pid,
        state="active",
        subscriptions=["/teleop/state"],
        counter_names=["received /teleop/state"],
        counter_values=np.array([received], np.float64),
    )


def test_a_recorder_records_for_the_page_once_it_has_received_something_from_it(tmp_path):
    recording = RecorderControl(tmp_path, ())
    assert (recording.records, recording.starting) == (False, False)
    assert recording.start() == ""
    try:
        pid = recording._child.pid
        for heard, records in (
            (None, False),
            ((pid, 0.0), False),
            ((pid + 1, 9.0), False),
            ((pid, 3.0), True),
        ):
            if heard is not None:
                recording.heard(status(*heard))
            assert (recording.records, recording.starting) == (records, not records)
            # The state is sent to browsers as it is.
            assert json.loads(json.dumps(recording.state()))["records"] is records
        bag = tmp_path / recording.state()["folder"]
        wait_for(lambda: bag.exists(), "the recorder's bag")
        assert recording.stop() == ""
        assert (recording.records, recording.starting) == (False, False)
        wait_for(lambda: recording.check() or not recording.state()["on"], "the recorder to end")
        assert RecorderControl(tmp_path, ()).state()["trouble"] == "", "its end was told"
    finally:
        recording.close()


PAGE = """\
import sys
import time
from pathlib import Path
from nodes.operator_page.recording import RecorderControl

recording = RecorderControl(Path(sys.argv[1]), ())
assert recording.start() == ""
print(recording._child.pid, recording.state()["folder"], flush=True)
time.sleep(600)
"""


def has_ended(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.parametrize("killed", ["the page", "both"])
def test_a_recording_whose_page_was_killed_is_finished_and_told_by_the_next_one(tmp_path, killed):
    """The bag stayed unfinished, and the car drove on unrecorded without a word."""
    page = subprocess.Popen(
        [sys.executable, "-c", PAGE, str(tmp_path)], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    try:
        pid, folder = page.stdout.readline().split()
        wait_for(lambda: list((tmp_path / folder).glob("*.mcap")), "the recorder's bag", 120.0)
        if killed == "both":
            os.kill(int(pid), signal.SIGKILL)
    finally:
        page.kill()
        page.communicate()
    wait_for(lambda: has_ended(pid), "the recorder to end", 120.0)
    if killed == "the page":
        assert read_info(tmp_path / folder).messages >= 0
    else:
        with pytest.raises(BagError, match="unfinished"):
            read_info(tmp_path / folder)
    following = RecorderControl(tmp_path, ())
    state = following.state()
    assert (state["on"], state["folder"]) == (False, folder)
    assert f"The recording to {folder} ended with an earlier page; start recording again" in state["trouble"]
    assert f"advnerf bag repair {tmp_path / folder} completes it" in state["trouble"]
    assert RecorderControl(tmp_path, (), operates=False).state()["trouble"] == ""
    wait_for(lambda: following.start() == "", "a name of a folder that is free")
    assert following.state()["trouble"] == ""
    following.close()
    assert RecorderControl(tmp_path, ()).state()["trouble"] == ""
