"""One exception tree: everything a user may see is an `AdvnerfError`, wherever it was defined."""

import ast
import builtins
from pathlib import Path

import pytest

from advnerf_core.errors import AdvnerfError
from hardware.errors import HardwareError, LinkLost
from hardware.worlds.lab.gl import TwinUnavailable
from nodes.runtime.errors import NodeFinished
from nodes.runtime.process import _one_line

ROOT = Path(__file__).parents[1]
PACKAGES = ("advnerf_core", "hardware", "calibration", "nodes")
# Caught where they are raised; no user sees them.
INTERNAL = {"NodeFinished", "_Stopped", "Damaged", "NotMet", "MetButLook"}


def exception_classes():
    """Every class of the packages with its bases, by name; from the source, so that no extra need be installed."""
    found = {}
    for package in PACKAGES:
        for file in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    found[node.name] = [base.id for base in node.bases if isinstance(base, ast.Name)]
    return found


def ancestors(name, classes):
    return {name}.union(*(ancestors(base, classes) for base in classes.get(name, ())))


def test_every_exception_of_the_packages_is_an_advnerf_error():
    classes = exception_classes()
    system = {
        name
        for name, value in vars(builtins).items()
        if isinstance(value, type) and issubclass(value, Exception)
    }
    exceptions = {name for name in classes if ancestors(name, classes) & system}
    assert len(exceptions) > 40
    strays = {name for name in exceptions if "AdvnerfError" not in ancestors(name, classes)}
    assert strays == INTERNAL


@pytest.mark.parametrize("error", [LinkLost("the port is gone"), TwinUnavailable("install libegl1")])
def test_device_errors_are_one_line_without_their_type(error):
    assert isinstance(error, HardwareError)
    assert isinstance(error, AdvnerfError)
    assert isinstance(error, RuntimeError)
    assert _one_line(error) == str(error)


def test_other_errors_keep_their_type_in_the_line():
    assert _one_line(KeyError("speed")) == "KeyError: 'speed'"
    assert not issubclass(NodeFinished, AdvnerfError)
