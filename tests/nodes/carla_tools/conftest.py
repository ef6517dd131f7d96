"""The scripted CARLA server of tests/hardware/carla_scene, for the commands."""

import importlib.util
import sys
from pathlib import Path

import pytest

_FILE = Path(__file__).parents[2] / "hardware" / "carla_scene" / "conftest.py"
_SPEC = importlib.util.spec_from_file_location("carla_conftest", _FILE)
_shared = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(_shared)

carla, TJunction, scripted, port = _shared.carla, _shared.TJunction, _shared.scripted, _shared.port
written_map, library, settings = _shared.written_map, _shared.library, _shared.settings


@pytest.fixture
def as_carla(monkeypatch, library):
    """`import carla` gives the scripted server."""
    monkeypatch.setitem(sys.modules, "carla", library)
    return library
