"""What the page learns from the resolved launch file of its run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nodes.runtime.config import parse_yaml
from nodes.runtime.paths import RESOLVED_NAME


@dataclass(frozen=True)
class Launched:
    """Facts of a launch.

    Attributes:
        known: Whether there is a resolved launch file.
        nodes: Names of the enabled nodes.
        holds: Whether the safety node requires a held button; None without a safety node.
        twin: Whether the simulated lab is one of the nodes.
    """

    known: bool = False
    nodes: tuple[str, ...] = ()
    holds: bool | None = None
    twin: bool = False


def read_launched(run_dir: Path) -> Launched:
    """Read the resolved launch file of a run, if there is one."""
    try:
        text = (run_dir / RESOLVED_NAME).read_text(encoding="utf-8")
    except FileNotFoundError:
        return Launched()
    entries = parse_yaml(text, RESOLVED_NAME).data.get("nodes") or {}
    enabled = {name: entry for name, entry in entries.items() if entry.get("if", True)}
    of_module = {entry.get("module"): entry.get("config") or {} for entry in enabled.values()}
    safety = of_module.get("nodes.safety")
    holds = None if safety is None else safety.get("teleop", "none") == "hold"
    return Launched(True, tuple(enabled), holds, "nodes.twin" in of_module)
