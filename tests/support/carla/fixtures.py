"""Fixtures that the tests of CARLA share. Without the client library the tests that need it are skipped."""

import socket
import sys

import pytest

from tests.support.carla import opendrive
from tests.support.carla import scripted as scripted_server


@pytest.fixture(scope="session")
def carla():
    """The real client library."""
    return pytest.importorskip("carla")


@pytest.fixture(scope="session")
def TJunction():
    return opendrive.TJunction


@pytest.fixture(scope="session")
def scripted():
    """The module of the scripted server."""
    return scripted_server


@pytest.fixture(scope="session")
def port():
    """A port where something listens, as a server would; what it says is played by the scripted client."""
    with socket.create_server(("127.0.0.1", 0), backlog=100) as listener:
        yield listener.getsockname()[1]


@pytest.fixture(scope="session")
def written_map(carla, TJunction):
    """The T-junction somewhere in a map, turned, on a hill."""
    return carla.Map("Carla/Maps/written", TJunction(x_m=20.0, y_m=15.0, z_m=2.5, yaw_rad=0.6).text())


@pytest.fixture
def library(carla, scripted, written_map):
    """The client library with a scripted server behind it."""
    library = scripted.Library(carla, scripted.World(carla, written_map, ground_m=2.5))
    yield library
    for thread in library.world.threads:
        thread.join()


@pytest.fixture
def settings(port):
    """A configuration for the scripted server: small pictures, no patience."""
    return {
        "server": {"port": port, "town": "written", "timeout_s": 20.0, "frame_timeout_s": 0.2},
        "render": {"settle_ticks": 2},
        "camera": {"width": 84, "height": 46, "x_m": 3.2, "z_m": 1.6, "pitch_down_rad": 0.14},
        "photo": {"width": 64, "height": 36},
    }


@pytest.fixture
def as_carla(monkeypatch, library):
    """`import carla` gives the scripted server."""
    monkeypatch.setitem(sys.modules, "carla", library)
    return library
