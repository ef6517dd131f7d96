"""What all tests share: live tests run again after they got no processor, and tests that spoil their process get one of their own.

No test meets the launches of the user, or of another run of the tests: each run has a runtime folder of its own.
"""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol
from hypothesis import HealthCheck, settings

from tests.support.processors import Shortage

os.environ.setdefault("MUJOCO_GL", "egl")  # before any test imports MuJoCo
# On a busy machine an example takes as long as it takes.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")
_ATTEMPTS, _REST_S = 5, 4.0
_INSIDE = "ADVNERF_TEST_IN_ITS_OWN_PROCESS"


class _Passed:
    """Notes the tests that pass, or are skipped, in a file.

    Args:
        file: The file.
    """

    def __init__(self, file: Path) -> None:
        self._file, self._good = file, {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._good[report.nodeid] = self._good.get(report.nodeid, True) and not report.failed
        if report.when == "teardown" and self._good.pop(report.nodeid):
            with self._file.open("a", encoding="utf-8") as file:
                file.write(f"{report.nodeid}\n")


def pytest_addoption(parser: pytest.Parser) -> None:
    """For `tests.support.default_tests`, which runs some tests in two attempts."""
    parser.addoption(
        "--passed", type=Path, help="file of tests that passed: they are left out, and others join them"
    )


# Collecting the tests makes a million objects that all stay: a fifth of its time went to the search for garbage among them.
gc.disable()


def pytest_collection_finish() -> None:
    """Search for garbage again, but not among what collecting the tests has made."""
    gc.freeze()
    gc.enable()


def pytest_configure(config: pytest.Config) -> None:
    """Give this run a runtime folder: ``advnerf disarm`` of a test must not stop the car of another."""
    folder = tempfile.mkdtemp(prefix="advnerf-tests-")
    before = os.environ.get("XDG_RUNTIME_DIR")
    os.environ["XDG_RUNTIME_DIR"] = folder

    def undo() -> None:
        shutil.rmtree(folder, ignore_errors=True)
        os.environ.pop("XDG_RUNTIME_DIR")
        if before is not None:
            os.environ["XDG_RUNTIME_DIR"] = before

    config.add_cleanup(undo)
    if (passed := config.getoption("--passed")) and not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Passed(passed))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what has passed already."""
    file = config.getoption("--passed")
    if file is not None and file.exists():
        passed = set(file.read_text(encoding="utf-8").splitlines())
        items[:] = [item for item in items if item.nodeid not in passed]


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Run a live test again that failed while the processors had no time to spare.

    The car stops when its nodes are late, as it should, whatever a test expects; and nodes are late where others take the processors,
    be it other processes or the host of a virtual machine. Where there was time to spare a failure is a failure at once.
    """
    if not item.get_closest_marker("live"):
        return None
    for attempt in range(_ATTEMPTS):
        shortage = Shortage()
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        why = shortage.found() if any(report.failed for report in reports) else ""
        again = bool(why) and attempt + 1 < _ATTEMPTS
        if again:
            item.session._setupstate.teardown_exact(None)  # what a failure leaves behind is not used again
            print(f"\n{item.nodeid} failed while {why}; again", file=sys.__stderr__)
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
    )
    if done.returncode != 0:
        pytest.fail(f"in its own process:\n{done.stdout}", pytrace=False)
    return True


@pytest.fixture(scope="module")
def browser():
    """Chromium without a window."""
    from playwright.sync_api import sync_playwright

    from tests.support.live.page_browser import CHROMIUM

    with sync_playwright() as playwright:
        made = playwright.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox"])
        yield made
        made.close()
