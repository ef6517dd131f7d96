"""What all tests share: which of them need the machine for themselves, and a process of its own for those that spoil theirs."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

# Where tests start processes, open sockets and terminals, or hold code to a clock; what lies below _COMPUTING only computes.
_LIVE = (
    "tests/nodes",
    "tests/hardware",
    "tests/docker",
    "tests/test_docs_policies.py",
)
_COMPUTING = (
    "tests/nodes/attacking", "tests/nodes/campaign", "tests/nodes/carla_tools", "tests/nodes/doctor/test_devices.py", "tests/nodes/doctor/test_launch.py",
    "tests/nodes/experiment", "tests/nodes/intersection", "tests/nodes/policy_data", "tests/nodes/runtime/test_bag",
    "tests/nodes/runtime/test_replay_attack.py", "tests/nodes/runtime/test_security.py", "tests/nodes/scene_import",
    "tests/nodes/test_attack.py", "tests/nodes/test_attack_handover.py", "tests/nodes/test_calibration_drive.py", "tests/nodes/test_cli",
    "tests/nodes/test_counterfactual.py", "tests/nodes/test_expert.py", "tests/nodes/test_policy_reference.py", "tests/nodes/test_scene_training.py",
    "tests/nodes/test_trials.py", "tests/hardware/cameras/test_conformance.py", "tests/hardware/carla_scene",
    "tests/hardware/twin",
)  # fmt: skip
_INSIDE = "ADVNERF_TEST_IN_ITS_OWN_PROCESS"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark by folder what must not share its cores."""
    for item in items:
        if item.nodeid.startswith(_LIVE) and not item.nodeid.startswith(_COMPUTING):
            item.add_marker(pytest.mark.live)


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
