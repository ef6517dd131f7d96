"""Network checks: the other host of a launch file, keys, the viewer's port, systems of the library ``motioncapture``."""

from __future__ import annotations

import errno
import importlib.util
import socket

from hardware.mocap.library import SYSTEMS
from nodes.gateway import GatewayConfig
from nodes.lab.doctor.check import FAILURE, OK, WARNING, CheckResult, report
from nodes.linking.keys import DRIVE, KeyFolder, require_keys
from nodes.runtime.errors import SecurityError

_CONNECT_S = 2.0


def gateway(config: GatewayConfig) -> list[CheckResult]:
    """Check the keys of this end, and whether the other host answers or the own ports are free."""
    address = config.listen or config.connect or ""
    rows = _keys(config, address)
    for port in (config.watch_port, config.drive_port):
        rows += _own_port(address, port) if config.listen else _other_host(address, port)
    return rows


def _keys(config: GatewayConfig, address: str) -> list[CheckResult]:
    store = None if config.keys is None else KeyFolder(config.keys)
    try:
        if config.listen:
            require_keys(address, store)
        if store is None:
            return report("keys", OK, f"none, on the loopback address {address}")
        store.secret(config.key)
        if not config.listen:
            store.public(config.peer_key)
            return report("keys", OK, f"ours is {config.key}, the other host's {config.peer_key}")
        drivers = ", ".join(store.allowed(DRIVE))
    except (SecurityError, OSError) as error:
        do = "create and allow keys with advnerf car keys new, add, allow (docs/two_hosts.md)"
        return report("keys", FAILURE, str(error), do)
    if not drivers:
        do = "advnerf car keys allow workstation --right drive"
        return report("keys", FAILURE, "no key may drive over the network", do)
    return report("keys", OK, f"ours is {config.key}; {drivers} may drive")


def _own_port(address: str, port: int) -> list[CheckResult]:
    with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError as error:
            mine = error.errno != errno.EADDRNOTAVAIL
            do = (
                f"stop the program that uses it (sudo ss -tlpn 'sport = {port}')"
                if mine
                else "use an address of this computer (ip addr lists them)"
            )
            return report("network", FAILURE, f"cannot listen on {address}:{port}: {error.strerror}", do)
    return report("network", OK, f"TCP {address}:{port} is free")


def _other_host(address: str, port: int) -> list[CheckResult]:
    try:
        socket.create_connection((address, port), timeout=_CONNECT_S).close()
    except OSError as error:
        why = error.strerror or str(error) or "no answer"
        do = "start the launch there; then check ping and its firewall (sudo ufw allow from ... to any port ...)"
        return report("network", WARNING, f"{address}:{port} does not answer: {why}", do)
    return report("network", OK, f"{address}:{port} answers")


def viewer(host: str, port: int) -> list[CheckResult]:
    """Check whether the viewer can listen."""
    if importlib.util.find_spec("foxglove") is None:
        return report("viewer", FAILURE, "foxglove-sdk is missing", "pip install 'advnerf[view]'")
    return [] if port == 0 else _own_port(host, port)


def mocap_library(system: str, hostname: str) -> list[CheckResult]:
    """Check whether the library is installed and its host can be resolved."""
    if importlib.util.find_spec("motioncapture") is None:
        do = "pip install 'advnerf[mocap]' (Linux on x86)"
        return report("VICON", FAILURE, "the library motioncapture is missing", do)
    if system not in SYSTEMS:
        return report("VICON", FAILURE, f"unknown system {system}", f"use one of {', '.join(SYSTEMS)}")
    try:
        socket.getaddrinfo(hostname, None)
    except OSError as error:
        do = "set vicon.hostname to its IP address"
        return report("VICON", FAILURE, f"{hostname}: {error.strerror or error}", do)
    return report("VICON", OK, f"{system} at {hostname}; the node reports the subjects")
