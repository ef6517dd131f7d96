"""Whether a launch file describes one car: a simulated one with the twin's parts, or a real one with what was measured of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from advnerf_core.documents import read_yaml
from calibration.schema import BY_CONSTRUCTION
from nodes.launching.launch_file import Plan

_TWIN, _MOTOR, _SAFETY = "nodes.twin", "nodes.motor", "nodes.safety"
_TWINS_PORT = "/vesc"


def mixtures(plan: Plan) -> dict[str, str]:
    """Parts of a launch that belong to different cars, by node. Files that are not there are left to others."""
    return dict(_mixtures(plan))


def _mixtures(plan: Plan) -> Iterator[tuple[str, str]]:
    of = {entry.module: name for name, entry in plan.nodes.items()}
    motor = of.get(_MOTOR)
    if motor is None or not isinstance(plan.documents[motor].data, dict):
        return
    document = plan.documents[motor]
    port, vehicle = str(document.data.get("port")), document.data.get("calibration")
    is_twins = port == f"{plan.run_dir}{_TWINS_PORT}"
    if _TWIN in of and not is_twins:
        yield (
            motor,
            (
                f"{document.place(('port',))}: expected {motor}.port {plan.run_dir}{_TWINS_PORT} beside the node {of[_TWIN]}, got {port}: a real car would "
                f"drive by simulated poses; set {of[_TWIN]}.if=false, or leave the port"
            ),
        )
    elif not is_twins and _method(vehicle) == BY_CONSTRUCTION:
        yield (
            motor,
            (
                f"{document.place(('calibration',))}: expected a measured {motor}.calibration for the controller at {port}, got {vehicle}, the simulated car's; set "
                "params.calibration to the folder of what was measured"
            ),
        )
    safety = plan.documents[of[_SAFETY]].data if _SAFETY in of else None
    if isinstance(safety, dict) and safety.get("vehicle") not in (None, vehicle):
        yield (
            motor,
            (
                f"{document.place(('calibration',))}: expected one vehicle file for {of[_SAFETY]} and {motor}, got {safety['vehicle']} and {vehicle}; the limits "
                "of one car do not hold for another"
            ),
        )


def _method(vehicle: object) -> str:
    """How a vehicle file says that it was measured; empty if it cannot be read."""
    try:
        found = read_yaml(Path(str(vehicle))).data
    except (OSError, ValueError):
        return ""
    return str(found.get("method", "")) if isinstance(found, dict) else ""
