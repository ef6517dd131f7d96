"""What all tests share: live tests run again after the host paused, and tests that spoil their process get one of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

from benchmarks.host_pauses import stolen

# A live test that fails while this share of the processors was withheld by the host says nothing.
_STOLEN_SHARE, _ATTEMPTS, _REST_S = 0.01, 5, 4.0
_INSIDE = "ADVNERF_TEST_IN_ITS_OWN_PROCESS"


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Run a live test again that failed while the host withheld the processors.

    On a shared host a virtual machine may stand still for half a second, and then a car stops as it should, whatever the test
    expects. The kernel counts such time; where it counts none (a machine of one's own), a failure is a failure at once.
    """
    if not item.get_closest_marker("live"):
        return None
    for attempt in range(_ATTEMPTS):
        before = stolen()
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        share = (stolen()[0] - before[0]) / max(1, stolen()[1] - before[1])
        again = (
            any(report.failed for report in reports) and share >= _STOLEN_SHARE and attempt + 1 < _ATTEMPTS
        )
        if again:
            print(
                f"\n{item.nodeid} failed while the host withheld {share:.0%} of the processors; again",
                file=sys.__stderr__,
            )
        else:
            for report in reports:
                item.ihook.pytest_runtest_logreport(report=report)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        if not again:
            break
        time.sleep(_REST_S)
    return True


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A temporary folder that other users can enter, as none of pytest's own can."""
    with tempfile.TemporaryDirectory() as name:
        os.chmod(name, 0o755)
        yield Path(name)


def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test marked ``own_process`` in a Python of its own.

    SDL ends the process's EGL display when its window closes; a renderer of the lab that lives in the same process is then blind.
    """
    if not pyfuncitem.get_closest_marker("own_process") or os.environ.get(_INSIDE):
        return None
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--override-ini=addopts=--import-mode=importlib",
    ]
    done = subprocess.run(
        [*command, pyfuncitem.nodeid],
        cwd=pyfuncitem.config.rootpath,
        env={**os.environ, _INSIDE: "1"},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=100,
    )
    if done.returncode != 0:
        pytest.fail(f"in its own process:\n{done.stdout}", pytrace=False)
    return True
