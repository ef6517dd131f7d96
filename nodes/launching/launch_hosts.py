"""Hosts of a launch file: selects the nodes of this host and adds the gateway that connects the two hosts.

A launch has at most two hosts: the one with an address listens (the car, a thin client), the other connects (the workstation). The
topic lists of the gateways follow from the topic table, which has the publisher of each topic, and from the hosts of the nodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from advnerf_core.documents import Document
from nodes.launching.launch_schema import LaunchFile, NodeEntry
from nodes.runtime.errors import ConfigError
from nodes.runtime.topics import STATUS_PREFIX, TOPICS, status_topic

GATEWAY = "gateway"
ALL_HOSTS = "all"
_OPERATOR, _HAND = "operator", "teleop"
_PAGE_MODULE, _ROS2_MODULE = "nodes.page", "nodes.ros2"
_HOST_COUNT = 2
# The safety node must run on the motor's computer, so that the network cannot come between the check and the motor.
_TOGETHER = ("safety", "motor")
_SAFETY_MODULE = "nodes.safety"
_COMMANDS = ("/policy/drive", "/expert/drive")


def choose_host(document: Document, launch: LaunchFile, host: str | None) -> None:
    """Remove the nodes of other hosts and add this host's gateway, in place.

    Args:
        document: The launch file as plain data.
        launch: The launch file as a typed object.
        host: Name of this host, ``all`` to run all nodes on this computer, or None if the file has no hosts.
    """
    _check(document, launch, host)
    if host is None or host == ALL_HOSTS:
        return
    exports, imports = routes(launch, host)
    if launch.keys is None:
        exports, imports = _watching_only(document, launch, host, exports, imports)
    document.data["nodes"] = {
        name: entry for name, entry in document.data["nodes"].items() if launch.nodes[name].host == host
    }
    config = _gateway_config(launch, host, exports, imports)
    document.data["nodes"][GATEWAY] = {
        "module": "nodes.gateway",
        "host": host,
        "stop_last": True,
        "config": config,
    }
    document.places[("nodes", GATEWAY)] = document.place(("hosts",))
    if host == _listener(launch) and not set(_COMMANDS).isdisjoint(imports):
        _require_clock(document, launch, host)


def _require_clock(document: Document, launch: LaunchFile, host: str) -> None:
    """Require the other host's clock offset for arming. The age of its commands is only as accurate as its clock."""
    other = next(name for name in launch.hosts if name != host)
    peer = launch.hosts[other].key or other
    for name, node in document.data["nodes"].items():
        if launch.nodes.get(name) is not None and launch.nodes[name].module == _SAFETY_MODULE:
            node["config"] = {"clock_peers": [peer], **(node.get("config") or {})}


def _watching_only(
    document: Document, launch: LaunchFile, host: str, exports: list[str], imports: list[str]
) -> tuple[list[str], list[str]]:
    """Routes of a launch without keys, which send nothing to the listening host. Statuses are dropped; other topics are refused."""
    listens = host == _listener(launch)
    towards = imports if listens else exports
    if commands := [topic for topic in towards if not topic.startswith(STATUS_PREFIX)]:
        raise ConfigError(
            f"{document.place(('hosts',))}: without keys the hosts can only watch each other, but {_listener(launch)} would accept "
            f"{', '.join(commands[:4])}{' and more' if len(commands) > 4 else ''} from the other, so any local process could drive the "
            f"car. Give --set keys=FOLDER (advnerf car keys new), run the nodes that command on {_listener(launch)} (and set operator: "
            f"{_listener(launch)}), or run all nodes on one computer with --host all"
        )
    return (exports, []) if listens else ([], imports)


def routes(launch: LaunchFile, host: str) -> tuple[list[str], list[str]]:
    """Topics that a host exports, and topics that it imports."""
    listener = _listener(launch)
    operator = operator_of(launch)
    exports, imports = [], []
    entries = {name: entry for name, entry in launch.nodes.items() if entry.enabled}
    from_ros2 = _taken_from_ros2(entries)
    for topic, row in TOPICS.items():
        if topic in from_ros2:
            source = from_ros2[topic]
        elif row.publisher == GATEWAY:
            source = listener
        elif row.publisher == _OPERATOR:
            source = operator
        elif row.publisher == _HAND:
            source = _hand_of(entries) or operator
        else:
            source = _host_of(row.publisher, entries)
        if source == host:
            exports.append(topic)
        elif source is not None:
            imports.append(topic)
    for name, entry in entries.items():
        (exports if entry.host == host else imports).append(status_topic(name))
    return exports, imports


def operator_of(launch: LaunchFile) -> str:
    """Host from which the operator arms and sends requests."""
    listener = _listener(launch)
    return launch.operator or next(name for name in launch.hosts if name != listener)


def _taken_from_ros2(entries: Mapping[str, NodeEntry]) -> dict[str, str | None]:
    """Hosts of the topics that ROS 2 supplies instead of a node of ours."""
    return {
        route["topic"]: entry.host
        for entry in entries.values()
        if entry.module == _ROS2_MODULE
        for route in entry.config.get("take") or ()
        if isinstance(route, dict) and "topic" in route
    }


def _hand_of(entries: Mapping[str, NodeEntry]) -> str | None:
    """Host of the node at which the operator holds a button and presses the e-stop: the operator page, or a teleop node."""
    pages = _operating_pages(entries)
    return next(iter(pages.values())) if pages else _host_of(_HAND, entries)


def _operating_pages(entries: Mapping[str, NodeEntry]) -> dict[str, str | None]:
    """Hosts of the pages that operate, by the nodes' names."""
    return {
        name: entry.host
        for name, entry in entries.items()
        if entry.module == _PAGE_MODULE and entry.config.get("role", "operate") == "operate"
    }


def _host_of(role: str, entries: Mapping[str, NodeEntry]) -> str | None:
    """Host of the node with a role, found by the node's name or module."""
    for name, entry in entries.items():
        if role in (name, entry.module.rsplit(".", 1)[-1]):
            return entry.host
    return None


def _listener(launch: LaunchFile) -> str:
    return next(name for name, entry in launch.hosts.items() if entry.address is not None)


def _gateway_config(launch: LaunchFile, host: str, exports: list[str], imports: list[str]) -> dict[str, Any]:
    listener = _listener(launch)
    entry = launch.hosts[listener]
    end = {"listen": entry.address} if host == listener else {"connect": entry.address}
    return {
        **end,
        "watch_port": entry.watch_port,
        "drive_port": entry.drive_port,
        "keys": launch.keys,
        "key": launch.hosts[host].key or host,
        "peer_key": entry.key or listener,
        "imports": imports,
        # The gateway itself measures the clock offset and publishes it on its own bus.
        "exports": exports,
    }


def _check(document: Document, launch: LaunchFile, host: str | None) -> None:
    place = document.place(("hosts",))
    if not launch.hosts:
        if host is not None and host != ALL_HOSTS:
            raise ConfigError(f"--host {host}: {document.source} has no hosts; remove --host")
        if named := [name for name, entry in launch.nodes.items() if entry.host]:
            raise ConfigError(
                f"{document.place(('nodes', named[0]))}: node {named[0]} has a host, but the file has no hosts; add hosts, or remove the key"
            )
        return
    known = ", ".join(launch.hosts)
    if host is None or (host != ALL_HOSTS and host not in launch.hosts):
        raise ConfigError(f"{place}: expected --host with one of {known}, or all; got {host}")
    listeners = [name for name, entry in launch.hosts.items() if entry.address is not None]
    if len(launch.hosts) != _HOST_COUNT or len(listeners) != 1:
        raise ConfigError(
            f"{place}: expected two hosts, one of them with an address, got {known} with addresses of "
            f"{', '.join(listeners) or 'none'}"
        )
    if launch.operator is not None and launch.operator not in launch.hosts:
        raise ConfigError(f"{document.place(('operator',))}: expected one of {known}, got {launch.operator}")
    for name, entry in launch.nodes.items():
        if entry.enabled and entry.host not in launch.hosts:
            raise ConfigError(
                f"{document.place(('nodes', name))}: node {name} needs a host of {known}; got {entry.host}"
            )
    enabled = {name: entry for name, entry in launch.nodes.items() if entry.enabled}
    homes = {role: home for role in _TOGETHER if (home := _host_of(role, enabled)) is not None}
    if len(set(homes.values())) > 1:
        raise ConfigError(
            f"{place}: expected safety and motor on one host, so that no network lies between them; got {homes}"
        )
    _check_pages(document, launch, enabled, homes.get("safety"))


def _check_pages(
    document: Document, launch: LaunchFile, entries: Mapping[str, NodeEntry], safety: str | None
) -> None:
    """Refuse a page whose requests, and whose e-stop, would not reach the safety node."""
    pages = _operating_pages(entries)
    if len(set(pages.values())) > 1:
        raise ConfigError(
            f"{document.place(('nodes',))}: expected one operator page, got {pages}; give the others role: watch"
        )
    for name, home in pages.items():
        if safety is not None and home not in (safety, operator_of(launch)):
            raise ConfigError(
                f"{document.place(('nodes', name))}: expected the page {name} on {operator_of(launch)}, from where people arm, got {home}: its e-stop "
                f"would not reach the car; set operator: {home}"
            )
