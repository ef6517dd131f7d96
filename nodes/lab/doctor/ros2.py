"""ROS 2 checks: the installed transports, and the Zenoh router of a launch file."""

from __future__ import annotations

import socket

from nodes.lab.doctor.check import ABSENT, FAILURE, OK, WARNING, CheckResult, report
from nodes.linking.ros2.transports import DDS, chosen_transport, installed_transports, is_loopback_interface
from nodes.linking.ros2.zenoh_settings import address_of, require_local_router, session_config
from nodes.ros2 import Ros2Config
from nodes.runtime.errors import ConfigError

_CHECK = "ROS 2"
_CONNECT_S = 2.0


def installed() -> list[CheckResult]:
    """Check which transports are installed."""
    found = installed_transports()
    if not found:
        return report(_CHECK, ABSENT, "no transport", "pip install 'advnerf[ros2]'")
    return report(_CHECK, OK, f"transports: {', '.join(found)}")


def node(config: Ros2Config) -> list[CheckResult]:
    """Check the transport of a ROS 2 node, and whether its Zenoh router answers."""
    try:
        transport = chosen_transport(config.transport)
    except ConfigError as error:
        return report(_CHECK, FAILURE, str(error), "pip install 'advnerf[ros2]'")
    local = is_loopback_interface(config.interface)
    rows = report(_CHECK, OK, f"{transport}, domain {config.domain_id} on {config.interface}")
    if transport == DDS:
        return rows
    session_config(config.zenoh, config.interface, local)
    if local:
        require_local_router(config.zenoh)
    silent = [endpoint for endpoint in config.zenoh.connects if not _answers(endpoint)]
    do = "start one (ros2 run rmw_zenoh_cpp rmw_zenohd), or add --set ros2.zenoh.router=true"
    return rows + [CheckResult(_CHECK, WARNING, f"no Zenoh router at {endpoint}", do) for endpoint in silent]


def _answers(endpoint: str) -> bool:
    try:
        socket.create_connection(address_of(endpoint), _CONNECT_S).close()
    except OSError:
        return False
    return True
