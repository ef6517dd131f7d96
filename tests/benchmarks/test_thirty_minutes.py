"""The judgement on half an hour of samples, on samples made by hand."""

import numpy as np
import pytest

from benchmarks.thirty_minutes import NODES, Stops, describe_drive, growth, missed
from nodes.bags.writer import BagWriter, SplitLimits
from nodes.runtime.messages import encode, pose_message


def samples(grows_mb=0.0, misses=0):
    """Half an hour in which the recorder grows steadily and the motor misses ticks at the end."""
    made = []
    for t_s in range(10, 1801, 10):
        nodes = {
            name: {"rss_mb": 60.0, "counters": {"ticks": 50.0 * t_s, "ticks_missed": 1.0}} for name in NODES
        }
        nodes["recorder"]["rss_mb"] += grows_mb * t_s / 1800
        nodes["motor"]["counters"]["ticks_missed"] += misses if t_s == 1800 else 0
        made.append({"t_s": float(t_s), "nodes": nodes, "numbers": {}})
    return made


def test_growth_is_that_of_the_node_between_the_warm_up_and_the_end():
    assert set(growth(samples(), 180.0).values()) == {0.0}
    grown = growth(samples(grows_mb=6.0), 180.0)
    assert grown["recorder"] == pytest.approx(6.0 * (1770 - 210) / 1800 / 60.7, rel=0.01)
    assert grown["motor"] == 0.0


def test_a_tick_missed_before_the_first_sample_is_not_counted_and_one_at_the_end_is():
    assert set(missed(samples()).values()) == {0}
    assert missed(samples(misses=1))["motor"] == 1


def test_the_drive_is_described_from_all_files_of_its_bag(tmp_path):
    with BagWriter(tmp_path / "bag", limits=SplitLimits(duration_s=0.5)) as writer:
        for i in range(201):  # 2 m along the first straight of the track, 5 cm beside it
            T = np.eye(4)
            T[:2, 3] = -0.9 + i * 0.005, -1.95
            t_ns = 1_800_000_000_000_000_000 + i * 10_000_000
            writer.write("/vicon/car", encode(pose_message(T, t_ns)), t_ns, t_ns, i)
    assert describe_drive(tmp_path / "bag").startswith(
        "1 m driven, mean |CTE| 0.050 m, largest 0.05 m, bag of "
    )
    assert (
        Stops([(12.3, "no image for 0.3 s")]).describe()
        == "1 stops, 0 of them while the host paused (12 s: no image for 0.3 s)"
    )
