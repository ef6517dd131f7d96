"""What the page says about its recorder, with a real one."""

import json

import numpy as np
import pytest

from nodes.operator_page.recording import RECORDER, RecorderControl
from nodes.runtime.messages import types
from tests.support.messages import filled
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live


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
    finally:
        recording.close()
