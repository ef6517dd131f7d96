"""A message whose publication claims to be in the future is as old as its receipt, for every receiver."""

import time

import numpy as np
import pytest

from nodes.runtime.bus import Bus
from nodes.runtime.clock import ManualClock, SystemClock
from nodes.runtime.messages import pose_message
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live


def test_a_publisher_whose_clock_is_an_hour_ahead(tmp_path):
    now = SystemClock().now()
    ahead = ManualClock(now.mono_ns + 3600 * 10**9, now.real_ns)
    with Bus(tmp_path, ahead) as liar, Bus(tmp_path) as reader:
        reader.subscribe("/vicon/car")
        liar.publisher("/vicon/car")
        liar.wait_for_subscribers(["/vicon/car"], 20.0)
        liar.publish("/vicon/car", pose_message(np.eye(4), now.real_ns))
        got = []
        wait_for(lambda: got.extend(reader.receive()) or got, "the message")
        assert got[0].info.publish_mono_ns <= time.monotonic_ns()
        assert got[0].info.fresh_mono_ns == got[0].info.publish_mono_ns
