"""One rule for every side of a comparison."""

import re
import time

import pytest

from benchmarks.timing import ProcessorUse, runs_in_turns, seconds_in_turns


def test_ways_run_equally_often_and_in_turns():
    calls = []
    ways = {"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}
    runs = runs_in_turns(ways, 3)
    assert calls == ["a", "b"] * 4  # the first of each does not count
    assert [len(taken) for taken in runs.values()] == [3, 3]


def test_the_median_counts_and_not_the_best():
    pauses = iter([0.0, 0.05, 0.001, 0.05])
    assert seconds_in_turns({"a": lambda: time.sleep(next(pauses))}, 3)["a"] >= 0.05


def test_no_repeat_is_refused():
    with pytest.raises(ValueError, match="at least one repeat, got 0"):
        runs_in_turns({"a": lambda: None}, 0)


def test_processor_use_names_the_process_and_the_others():
    use = ProcessorUse()
    until = time.process_time() + 0.05
    while time.process_time() < until:
        pass
    own, others = (float(part) for part in re.findall(r"\d+\.\d", use.text()))
    assert 0.1 <= own <= 1.1
    assert others >= 0.0
