"""Whether a launch file describes one car: a simulated one with the twin's parts, or a real one with what was measured of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_yaml
from calibration.schema import BY_CONSTRUCTION
from nodes.control.arming import MAX_SPEED_MPS
from nodes.launching.launch_file import Plan
from nodes.runtime.twin_port import PORT

_TWIN, _MOTOR, _SAFETY = "nodes.twin", "nodes.motor", "nodes.safety"
_COMMANDING = ("nodes.expert", "nodes.policy", "nodes.teleop", "nodes.calibration_drive")
# Where a node names the device that only the twin of the same run makes: its place, and the kinds of device that are one.
_OF_THE_TWIN = (
    (_MOTOR, ("port",), ()),
    ("nodes.camera", ("source", "path"), ("socket",)),
    ("nodes.monitor", ("display", "path"), ("twin",)),
)
# Nodes whose messages are conditions of arming only if the safety node waits for them.
_CONDITIONS = (
    (_MOTOR, "motor", "the car drives without a check of its time-out, its wheels and its telemetry"),
    ("nodes.camera", "camera", "the car drives on after its camera has died"),
)


def mixtures(plan: Plan) -> dict[str, str]:
    """Parts of a launch that belong to different cars, by node. Files that are not there are left to others."""
    of = {entry.module: name for name, entry in plan.nodes.items()}
    motor, twin, safety = of.get(_MOTOR), of.get(_TWIN), of.get(_SAFETY)
    if motor is None or not isinstance(plan.documents[motor].data, dict):
        return {}
    document, found = plan.documents[motor], dict[str, str]()
    port, vehicle, twins = (
        str(document.data.get("port")),
        document.data.get("calibration"),
        f"{plan.run_dir}/{PORT}",
    )
    on_twin = _placed(port) == _placed(twins)
    if twin is not None and not on_twin:
        found[motor] = (
            f"{document.place(('port',))}: expected {motor}.port {twins} beside the node {twin}, got {port}: a real car would drive by simulated poses; "
            f"set {twin}.if=false, or leave the port"
        )
    elif not on_twin and _method(vehicle) == BY_CONSTRUCTION:
        found[motor] = (
            f"{document.place(('calibration',))}: expected a measured {motor}.calibration for the controller at {port}, got {vehicle}, the simulated car's; "
            "set params.calibration to the folder of what was measured"
        )
    guard = None if safety is None else plan.documents[safety].data
    if safety is not None and isinstance(guard, dict):
        if unwatched := _unwatched(guard, of):
            found[safety] = f"{plan.documents[safety].place(('nodes',))}: {unwatched}"
        found |= _too_fast(plan, guard)
    if safety is not None and isinstance(guard, dict) and guard.get("vehicle") not in (None, vehicle):
        found[safety] = (
            f"{plan.documents[safety].place(('vehicle',))}: expected one vehicle file for {safety} and {motor}, got {guard['vehicle']} and {vehicle}; the "
            "limits of one car do not hold for another"
        )
    return found


def unprovided(plan: Plan) -> list[str]:
    """Devices in the folders of the run that no node of the launch makes, as one line each."""
    if any(entry.module == _TWIN for entry in plan.nodes.values()):
        return []
    own, found = {Path(folder).resolve() for folder in (plan.run_dir, plan.socket_dir)}, []
    for module, place, kinds in _OF_THE_TWIN:
        for name in (name for name, entry in plan.nodes.items() if entry.module == module):
            document = plan.documents[name].part(place)
            parent = plan.documents[name].part(place[:-1]).data
            value, kind = document.data, parent.get("kind") if isinstance(parent, dict) else None
            if isinstance(value, str) and _placed(value).parent in own and (not kinds or kind in kinds):
                found.append(
                    f"{plan.documents[name].place(place)}: expected a real device as {name}.{'.'.join(place)}, got {value}, which only the simulated "
                    "lab of a run makes, and this launch has none; name the device, or enable the lab (twin.if=true)"
                )
    return found


def _unwatched(guard: dict[str, Any], of: Mapping[str, str]) -> str:
    """What is wrong with the nodes that the safety node waits for; empty if the motor and the camera are among them."""
    named = guard.get("nodes")
    for module, name, why in _CONDITIONS:
        if module not in of:
            continue
        if of[module] != name:
            return f"expected the node of {module} to be called {name}, as the safety node knows it, got {of[module]}; rename it"
        if isinstance(named, list) and name not in named:
            return f"expected {name} among safety.nodes, got {', '.join(map(str, named)) or 'none'}: without it, {why}; add it"
    return ""


def _too_fast(plan: Plan, guard: dict[str, Any]) -> dict[str, str]:
    """Nodes that command the car faster than the safety node lets it drive: it would never be armed, or stop at their first command."""
    limit_mps, found = guard.get("max_speed_mps", MAX_SPEED_MPS), dict[str, str]()
    for name, entry in plan.nodes.items():
        document = plan.documents[name]
        wanted = document.data.get("speed_mps") if isinstance(document.data, dict) else None
        numbers = all(isinstance(each, int | float) for each in (wanted, limit_mps))
        if entry.module in _COMMANDING and numbers and wanted > limit_mps:
            found[name] = (
                f"{document.place(('speed_mps',))}: expected {name}.speed_mps of at most safety.max_speed_mps, {limit_mps:g} m/s, got {wanted:g}: the safety "
                "node would stop the car at the first command; correct either"
            )
    return found


def _placed(port: str) -> Path:
    """A port in its resolved folder. The port itself may be a link, to another pseudo-terminal at each start."""
    return Path(port).parent.resolve() / Path(port).name


def _method(vehicle: object) -> str:
    """How a vehicle file says that it was measured; empty if it cannot be read."""
    try:
        found = read_yaml(Path(str(vehicle))).data
    except (OSError, ValueError):
        return ""
    return str(found.get("method", "")) if isinstance(found, dict) else ""
