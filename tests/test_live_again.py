"""A live test is run again only if the host withheld the processors while it failed."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytest_plugins = ["pytester"]

CONFTEST = """
import itertools
import sys
sys.path.insert(0, {root!r})
import tests.conftest as ours
from tests.conftest import pytest_runtest_protocol

count = itertools.count()

def stolen():
    k = next(count)
    return {share} * k, 100 * k

ours.stolen, ours._REST_S = stolen, 0.0

def pytest_configure(config):
    config.addinivalue_line("markers", "live: a test")
"""
TEST = """
import pathlib
import pytest

@pytest.mark.live
def test_it():
    runs = pathlib.Path("runs.txt")
    runs.write_text((runs.read_text() if runs.exists() else "") + "x")
    assert len(runs.read_text()) > {failures}
"""


@pytest.mark.parametrize(
    ("share", "failures", "outcome", "runs"),
    [(10, 2, "passed", 3), (0, 2, "failed", 1), (10, 99, "failed", 5)],
)
def test_a_live_test_is_run_again_while_the_host_withholds_the_processors(
    pytester, share, failures, outcome, runs
):
    pytester.makeconftest(CONFTEST.format(share=share, root=str(ROOT)))
    pytester.makepyfile(TEST.format(failures=failures))
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider")
    result.assert_outcomes(**{outcome: 1})
    assert len((pytester.path / "runs.txt").read_text()) == runs
