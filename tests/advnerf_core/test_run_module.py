"""A folder's own modules never stand for installed ones, and are found all the same."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from advnerf_core.policies.contract import PolicyContractError
from advnerf_core.policies.load import load_adapted
from advnerf_core.run_module import module_command

ROOT = Path(__file__).parents[2]
PACKAGES = ("advnerf_core", "hardware", "calibration", "nodes")
SHOW = """
import json, sys, hardware.errors, nodes, yaml
print(json.dumps([hardware.__file__, nodes.__file__, yaml.__file__, sys.argv, __name__, __spec__.name]))
"""


@pytest.fixture
def strangers(tmp_path, monkeypatch):
    """A working folder with modules that have the names of ours and of a library."""
    for name in ("hardware.py", "yaml.py", "nodes/__init__.py", "calibration/__init__.py", "runpy.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("raise SystemExit('the module of a stranger')\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments, **environment):
    return subprocess.run(
        module_command(*arguments),
        capture_output=True,
        text=True,
        timeout=600,
        env={**os.environ, **environment},
    )


@pytest.mark.parametrize("path", ["", os.pathsep], ids=["unset", "with an empty entry"])
def test_the_working_folder_is_searched_last(strangers, path):
    (strangers / "own_node.py").write_text(SHOW)
    done = run("own_node", "--check", "a b", PYTHONPATH=path)
    assert done.returncode == 0, done.stderr
    *libraries, arguments, name, spec = json.loads(done.stdout)
    assert len(libraries) == 3
    assert not any(Path(file).is_relative_to(strangers) for file in libraries)
    assert Path(arguments[0]) == strangers / "own_node.py"
    assert (arguments[1:], name, spec) == (["--check", "a b"], "__main__", "own_node")


def test_a_package_and_what_it_imports_beside_it_are_found(strangers):
    (strangers / "robot").mkdir()  # a package without __init__, as in many a folder
    (strangers / "robot" / "drive.py").write_text("from robot.gains import P\nprint(P)\n")
    (strangers / "robot" / "gains.py").write_text("P = 3\n")
    done = run("robot.drive")
    assert (done.returncode, done.stdout) == (0, "3\n"), done.stderr


def test_a_module_that_is_not_there_is_named(strangers):
    done = run("robot.drive")
    assert done.returncode == 1
    assert "No module named" in done.stderr.splitlines()[-1]
    assert "robot" in done.stderr.splitlines()[-1]


def test_a_node_of_ours_starts_among_strangers(strangers):
    done = run("nodes.vicon", "--help")
    assert done.returncode == 0, done.stderr
    assert "The vicon node" in done.stdout


def test_a_policy_of_ones_own_is_found_but_does_not_replace_an_installed_module(strangers):
    (strangers / "my_driver_7.py").write_text("def factory():\n    return 4\n")
    with pytest.raises(PolicyContractError, match=r"my_driver_7:factory\(\) to return adapt"):
        load_adapted("my_driver_7:factory")
    with pytest.raises(PolicyContractError, match=r"cannot find yaml:factory: module 'yaml'.* has no"):
        load_adapted("yaml:factory")


def test_children_are_started_in_one_place():
    """``python -m`` would search the working folder first."""
    own = re.compile(r"sys\.executable,\s*(\"-m\"|'-m')")
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    assert len(files) > 300
    assert [str(file) for file in files if own.search(file.read_text(encoding="utf-8"))] == []


def test_it_needs_nothing_of_newer_pythons():
    """The module must run before the search path is in order, with what every Python has built in."""
    code = f"import runpy, sys\nsys.argv = ['x', 'this']\nrunpy.run_path({module_command('x')[1]!r})"
    assert subprocess.run([sys.executable, "-I", "-c", code], timeout=600).returncode == 0
