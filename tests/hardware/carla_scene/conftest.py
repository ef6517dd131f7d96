"""Loads the helpers that the tests of CARLA share; without the client library the tests that need it are skipped."""

import importlib.util
import sys
from pathlib import Path

import pytest


def _load(name):
    spec = importlib.util.spec_from_file_location(f"carla_{name}", Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def carla():
    """The real client library."""
    return pytest.importorskip("carla")


@pytest.fixture(scope="session")
def TJunction():
    return _load("opendrive").TJunction
