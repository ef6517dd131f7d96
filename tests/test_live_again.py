"""A live test is run again only if the processors had no time to spare while it failed; what has passed is left out."""

import os
import time
from pathlib import Path

import pytest

from tests.support.processors import Shortage

ROOT = Path(__file__).parents[1]
pytest_plugins = ["pytester"]

CONFTEST = """
import sys
sys.path.insert(0, {root!r})
import tests.conftest as ours
from tests.conftest import pytest_runtest_protocol

class Shortage:
    def found(self):
        return {why!r}

ours.Shortage, ours._REST_S = Shortage, 0.0

def pytest_configure(config):
    config.addinivalue_line("markers", "live: a test")
"""
TEST = """
import pathlib
import pytest

@pytest.fixture(scope="module")
def of_all():
    marks = pathlib.Path("made.txt")
    marks.write_text((marks.read_text() if marks.exists() else "") + "x")

@pytest.mark.live
def test_it(of_all):
    runs = pathlib.Path("runs.txt")
    runs.write_text((runs.read_text() if runs.exists() else "") + "x")
    assert len(runs.read_text()) > {failures}

def test_the_next(of_all):
    pass
"""


@pytest.mark.parametrize(
    ("why", "failures", "outcomes", "runs"),
    [
        ("it was busy", 2, {"passed": 2}, 3),
        ("", 2, {"passed": 1, "failed": 1}, 1),
        ("it was busy", 99, {"passed": 1, "failed": 1}, 5),
    ],
)
def test_a_live_test_that_got_no_processor_is_run_again_with_fresh_fixtures(
    pytester, why, failures, outcomes, runs
):
    pytester.makeconftest(CONFTEST.format(why=why, root=str(ROOT)))
    pytester.makepyfile(TEST.format(failures=failures))
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider")
    result.assert_outcomes(**outcomes)
    assert len((pytester.path / "runs.txt").read_text()) == runs
    assert len((pytester.path / "made.txt").read_text()) == runs


def stat(folder, **spent):
    """A count of one processor; times that are not given stand still [jiffies]."""
    file, kinds = (
        folder / "stat",
        ("user", "nice", "system", "idle", "iowait", "irq", "softirq", "steal", "guest", "guest_nice"),
    )
    lines = [
        " ".join([f"cpu{number}", *(str(spent.get(kind, 0)) for kind in kinds)])
        for number in sorted(os.sched_getaffinity(0))
    ]
    file.write_text("\n".join(["cpu 1 2 3 4 5 6 7 8 9 10", *lines, "intr 5 6"]))
    return file


@pytest.mark.parametrize(
    ("spent", "why"),
    [
        ({"user": 50, "system": 20, "idle": 30}, ""),
        ({"user": 60, "system": 20, "idle": 20}, "the processors had 20% of their time to spare"),
        ({"user": 60, "system": 10, "nice": 20, "iowait": 10}, ""),
        ({"user": 20, "idle": 78, "steal": 2}, "the host withheld 2% of the processors"),
        ({}, "the processors had 0% of their time to spare"),
    ],
)
def test_who_had_no_time_to_spare(tmp_path, spent, why):
    shortage = Shortage(stat(tmp_path))
    stat(tmp_path, **spent)
    assert shortage.found() == why


def test_the_real_count_of_a_pause_is_read():
    shortage = Shortage()
    time.sleep(0.2)
    assert "%" in shortage.found() or shortage.found() == ""


def test_what_passed_is_noted_and_left_out_the_next_time(pytester):
    pytester.makeconftest(f"import sys; sys.path.insert(0, {str(ROOT)!r}); from tests.conftest import *")
    pytester.makepyfile("import os\ndef test_a(): pass\ndef test_b(): assert os.environ.get('B')\n")
    options = ("-p", "no:cacheprovider", "--passed", "passed.txt")
    pytester.runpytest_subprocess(*options, "-n", "1").assert_outcomes(passed=1, failed=1)
    pytester._monkeypatch.setenv("B", "1")
    pytester.runpytest_inprocess(*options).assert_outcomes(passed=1)
    assert pytester.runpytest_inprocess(*options).ret == pytest.ExitCode.NO_TESTS_COLLECTED
