"""Deadlines and child processes: libraries that are missing, broken, hung, or take their process with them."""

import threading

import pytest

from hardware.errors import LinkLost
from nodes.lab.doctor import cameras, graphics
from nodes.lab.doctor.check import (
    ABSENT,
    FAILURE,
    OK,
    WARNING,
    CheckResult,
    DoctorCheck,
    ProbeResult,
    examine,
    in_child,
    worst,
)

pytestmark = pytest.mark.live


def test_a_hung_check_costs_its_deadline_and_the_others_are_told_in_order():
    never = threading.Event()

    def fine(name):
        return lambda: [CheckResult(name, OK, "there")]

    def lost():
        raise LinkLost("lost the camera")

    def defect():
        return [][1]

    found = list(
        examine(
            [
                DoctorCheck("a", fine("a")),
                DoctorCheck("b", never.wait, 0.2, "unplug it"),
                DoctorCheck("c", lost),
                DoctorCheck("d", defect),
                DoctorCheck("e", fine("e")),
            ]
        )
    )
    never.set()
    assert [(row.check, row.state) for row in found] == [
        ("a", OK),
        ("b", FAILURE),
        ("c", FAILURE),
        ("d", WARNING),
        ("e", OK),
    ]
    assert (found[1].found, found[1].do) == ("no answer within 0.2 s", "unplug it")
    assert found[2].found == "lost the camera"
    assert "IndexError" in found[3].found
    assert worst(found) == FAILURE
    assert worst([]) == OK
    assert worst([CheckResult("x", ABSENT, ""), CheckResult("y", WARNING, "")]) == WARNING


@pytest.fixture
def library(tmp_path, monkeypatch):
    """Puts a Python package of the given name and text before all others, for child processes."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    # Byte code is told from its source by second and size, and a text of a test takes the place of another within one second.
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    return lambda name, text: (tmp_path / f"{name}.py").write_text(text)


def test_a_vendors_library_that_hangs_is_killed(library):
    library("depthai", "import time\ntime.sleep(3600)\n")
    (found,) = cameras.oaks(timeout_s=1.0)
    assert found.state == WARNING
    assert "no answer within 1 s" in found.found


def test_a_library_that_crashes_or_refuses_is_one_line(library):
    library("mujoco", "import os\nos.abort()\n")
    (found,) = graphics.egl(required=True)
    assert (found.state, "ended by signal 6" in found.found) == (FAILURE, True)
    library("mujoco", "raise ImportError('libEGL.so.1: cannot open\\nshared object file')\n")
    (found,) = graphics.egl()
    assert found.state == WARNING
    assert "ImportError: libEGL.so.1: cannot open shared object file" in found.found
    assert "apt-get install libegl1" in found.do


def test_what_is_not_installed_is_absent_unless_it_is_needed(library):
    library("depthai", "raise ModuleNotFoundError('No module named depthai', name='depthai')\n")
    assert [row.state for row in (*cameras.oaks(), *cameras.oaks(required=True))] == [ABSENT, FAILURE]
    library("torch", "raise ModuleNotFoundError('No module named torch', name='torch')\n")
    assert [row.state for row in (*graphics.torch(), *graphics.torch(required=True))] == [ABSENT, FAILURE]
    assert graphics.torch()[0].do == "pip install 'advnerf[core]'"  # torch itself is installed here


def test_a_library_that_is_only_slow_is_not_to_be_installed(monkeypatch):
    late = ProbeResult(None, "no answer within 60 s", late=True)
    monkeypatch.setattr(graphics, "in_child", lambda probe: late)
    rows = [*graphics.torch(True), *graphics.egl(True), *graphics.llvm(), *graphics.screens()]
    for row in rows:
        assert "no answer within 60 s" in row.found
        assert row.do == "run advnerf doctor again when this computer has less to do"


CUDA = """
class cuda:
    is_available, device_count = staticmethod(lambda: {gpus} > 0), staticmethod(lambda: {gpus})
    get_device_name = staticmethod(lambda k: "H200")
class version:
    cuda = "12.8"
__version__ = "2.9.0"
"""


def test_gpus_are_named_and_a_build_that_sees_none_is_a_warning(library):
    library("torch", CUDA.format(gpus=1))
    assert graphics.torch() == [CheckResult("torch", OK, "2.9.0, CUDA 12.8: H200")]
    library("torch", CUDA.format(gpus=0))
    (found,) = graphics.torch()
    assert (found.state, "nvidia-smi" in found.do) == (WARNING, True)


def test_output_of_a_library_does_not_disturb_the_answer(library):
    library(
        "depthai",
        "print('[info] hello')\nclass Device:\n    getAllAvailableDevices = staticmethod(lambda: [])\n",
    )
    assert in_child("oaks").data == []
    assert cameras.oaks()[0].state == ABSENT
