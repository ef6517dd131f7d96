"""Facts of a launch, from the resolved launch file of its run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.documents import Document, read_yaml
from nodes.launching.launch_hosts import GATEWAY
from nodes.launching.running import has_ended, is_alive
from nodes.runtime.errors import ConfigError
from nodes.runtime.paths import RESOLVED_NAME


@dataclass(frozen=True)
class Launched:
    """Facts of a launch.

    Attributes:
        known: Whether there is a resolved launch file.
        nodes: Names of the enabled nodes.
        holds: Whether the safety node requires a held button; None without a safety node.
        twin: Whether the simulated lab is one of the nodes.
        port: Serial device of the motor node; empty without one.
        vehicle: Vehicle calibration file of the motor node; empty without one.
        relayed: Topics of the other host, which this host's gateway publishes; none without a gateway.
        address: Address of the other host, if this one connects to it; else empty.
    """

    known: bool = False
    nodes: tuple[str, ...] = ()
    holds: bool | None = None
    twin: bool = False
    port: str = ""
    vehicle: str = ""
    relayed: tuple[str, ...] = ()
    address: str = ""

    def car(self, run_dir: Path) -> str:
        """Describe the car that the launch drives."""
        if not self.port:
            return "no motor node on this host"
        simulated = self.twin and Path(self.port).parent == run_dir
        what = "the simulated car" if simulated else f"a REAL car at {self.port}"
        return f"{what}, {self.vehicle}" if self.vehicle else what


def _is_node(entry: Any) -> bool:
    return isinstance(entry, dict) and isinstance(entry.get("config") or {}, dict)


def read_launched(run_dir: Path) -> Launched:
    """Read the resolved launch file of a run, if there is one.

    Raises:
        ConfigError: The file is damaged, or is not what a launch writes.
    """
    file = run_dir / RESOLVED_NAME
    try:
        return facts_of(read_yaml(file))
    except FileNotFoundError:
        return Launched()


def facts_of(resolved: Document) -> Launched:
    """Facts of a launch from its resolved launch file, such as the one attached to a bag.

    Raises:
        ConfigError: It is not what a launch writes.
    """
    launch = resolved.data
    entries = (launch.get("nodes") or {}) if isinstance(launch, dict) else None
    if not isinstance(entries, dict) or not all(map(_is_node, entries.values())):
        raise ConfigError(
            f"{resolved.source}: expected nodes with their keys, as advnerf launch writes them, got others; start the launch again"
        )
    enabled = {name: entry for name, entry in entries.items() if entry.get("if", True)}
    of_module = {entry.get("module"): entry.get("config") or {} for entry in enabled.values()}
    safety = of_module.get("nodes.safety")
    holds = None if safety is None else safety.get("teleop", "none") == "hold"
    motor = of_module.get("nodes.motor", {})
    port, vehicle = str(motor.get("port", "")), str(motor.get("calibration", ""))
    gateway = of_module.get("nodes.gateway", {})
    relayed, address = tuple(map(str, gateway.get("imports") or ())), str(gateway.get("connect") or "")
    return Launched(True, tuple(enabled), holds, "nodes.twin" in of_module, port, vehicle, relayed, address)


def why_unreachable(run_dir: Path) -> str:
    """Why no request in a run folder whose launch is not running reaches its car. Empty if it may, also in a folder without a launch.

    Raises:
        ConfigError: The resolved launch file is damaged.
    """
    launched = read_launched(run_dir)
    if "/safety/state" in launched.relayed and not is_alive(run_dir, GATEWAY):
        return "this host's launch has ended and cannot reach the car; run advnerf disarm on the car"
    if launched.known and has_ended(run_dir):
        return "all nodes of this launch have ended; the motor controller brakes after its own timeout"
    return ""
