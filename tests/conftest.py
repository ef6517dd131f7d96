"""What all tests share: a process of its own for tests that spoil the one they run in."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

_INSIDE = "ADVNERF_TEST_IN_ITS_OWN_PROCESS"


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
        [*command, pyfuncitem.nodeid], cwd=pyfuncitem.config.rootpath, env={**os.environ, _INSIDE: "1"}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=100,
    )  # fmt: skip
    if done.returncode != 0:
        pytest.fail(f"in its own process:\n{done.stdout}", pytrace=False)
    return True
