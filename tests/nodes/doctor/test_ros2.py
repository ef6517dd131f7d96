"""What advnerf doctor says about ROS 2: real ports of this computer, and packages that are missing."""

import socket

import pytest

from nodes.lab.doctor import ros2
from nodes.lab.doctor.check import ABSENT, FAILURE, OK, WARNING
from nodes.linking.ros2 import transports
from nodes.ros2 import Ros2Config
from nodes.runtime.errors import SecurityError


@pytest.fixture
def installed(monkeypatch):
    names = {"cyclonedds", "zenoh"}
    monkeypatch.setattr(transports, "find_spec", lambda name: name if name in names else None)
    return names


def node(**config):
    return ros2.node(Ros2Config.model_validate({"send": [{"topic": "/odom"}], **config}))


def test_the_installed_transports_are_named(installed):
    (row,) = ros2.installed()
    assert (row.state, row.found) == (OK, "transports: dds, zenoh")
    installed.clear()
    (row,) = ros2.installed()
    assert (row.state, row.do) == (ABSENT, "pip install 'advnerf[ros2]'")


def test_a_missing_transport_fails_the_launch(installed):
    assert [row.state for row in node()] == [OK]
    installed.remove("cyclonedds")
    (row,) = node(transport="dds")
    assert row.state == FAILURE
    assert "'transport: zenoh' runs on arm64" in row.found


def test_a_router_is_asked_for(installed):
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/localhost:{server.getsockname()[1]}"
        rows = node(transport="zenoh", zenoh={"connect": [endpoint]})
        assert [row.state for row in rows] == [OK]
    rows = node(transport="zenoh", zenoh={"connect": [endpoint]})
    assert [row.state for row in rows] == [OK, WARNING]
    assert rows[1].found == f"no Zenoh router at {endpoint}"
    assert [row.state for row in node(transport="zenoh", zenoh={"router": True})] == [OK]


def test_a_router_that_others_reach_is_refused(installed):
    with socket.create_server(("0.0.0.0", 0)) as server:
        endpoint = f"tcp/localhost:{server.getsockname()[1]}"
        with pytest.raises(SecurityError, match="accepts connections from other computers"):
            node(transport="zenoh", zenoh={"connect": [endpoint]})
