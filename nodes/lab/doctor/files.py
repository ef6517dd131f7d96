"""Checks of the files that a launch file names: whether calibration, room, attack, policy and bag exist, load, and fit together."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from advnerf_core.attack.artifact import load_attack
from advnerf_core.errors import AdvnerfError
from advnerf_core.strict import validate
from calibration.panel import MonitorPanel, require_fits, target_size
from calibration.schema import (
    Calibration,
    CalibrationError,
    CameraCalibration,
    RoomCalibration,
    TargetCalibration,
    VehicleCalibration,
    load_calibration,
)
from nodes.calibration_drive import UNREAD_KEYS
from nodes.compositor import show
from nodes.lab.doctor.check import FAILURE, OK, WARNING, CheckResult, report
from nodes.launching.launch_file import Plan
from nodes.safety import SafetyConfig

_CURE = "run advnerf car calibrate (docs/calibration.md), or set params.calibration to the right folder"
_PATH_CURE = "correct the path, which is relative to the current folder"
_COMMON: dict[str, type[Calibration]] = {
    "camera": CameraCalibration, "target": TargetCalibration, "room": RoomCalibration, "vehicle": VehicleCalibration,
}  # fmt: skip
# The key "calibration" means the calibration of the node's own device.
_OWN: dict[str, type[Calibration]] = {"nodes.camera": CameraCalibration, "nodes.motor": VehicleCalibration}
# Keys that a node does not read, by its module.
_UNREAD = {"nodes.calibration_drive": UNREAD_KEYS}
_SAFETY = "nodes.safety"
_FILES = (".safetensors", ".onnx", ".pt2", ".conf", ".yaml", ".mcap", ".db3", ".bag")


def calibrations(plan: Plan) -> list[CheckResult]:
    """Load every calibration file once."""
    rows, good = [], []
    for file, kind in dict.fromkeys(_calibration_files(plan)):
        try:
            found = load_calibration(kind, file)
            if isinstance(found, CameraCalibration):
                _ = found.mount  # an error says that it does not look ahead
            good.append((file, found))
        except (AdvnerfError, OSError, ValueError) as error:
            rows += report("calibration", FAILURE, str(error), _CURE)
    if good:
        oldest = min(good, key=lambda item: item[1].date)
        text = f"{', '.join(str(file) for file, _ in good)}; the oldest, {oldest[0].name}, is from {oldest[1].date}"
        rows += report("calibration", OK, text)
        newest = max(good, key=lambda item: item[1].date)
        if newest[1].date > datetime.date.today() + datetime.timedelta(days=1):
            rows += report(
                "calibration",
                WARNING,
                f"{newest[0]} is from {newest[1].date}, which is still to come: is the date of the file wrong, or this computer's clock?",
                "correct it",
            )
    return rows


def _calibration_files(plan: Plan) -> Iterator[tuple[Path, type[Calibration]]]:
    for name, entry in plan.nodes.items():
        data = plan.documents[name].data
        for key, value in (data if isinstance(data, dict) else {}).items():
            kind = _OWN.get(entry.module) if key == "calibration" else _COMMON.get(key)
            if kind is not None and isinstance(value, str):
                yield Path(value), kind


def named(plan: Plan) -> list[CheckResult]:
    """Check that every other file exists, that attacks fit camera and face, and that the car can be armed in the room."""
    return [*_absent(plan), *_attacks(plan), *_margins(plan)] or report(
        "files", OK, "all files that the nodes name exist"
    )


def unusable(plan: Plan) -> list[str]:
    """The errors of calibrations, attacks and the fence's margin, without which no node starts, as one line each."""
    rows = (*calibrations(plan), *_attacks(plan), *_margins(plan))
    return [_line(row) for row in rows if row.state == FAILURE]


def missing(plan: Plan) -> list[str]:
    """All other files that the nodes name and that do not exist, as one line each."""
    return [_line(row) for row in _absent(plan)]


def _absent(plan: Plan) -> list[CheckResult]:
    known = {str(file) for file, _ in _calibration_files(plan)}
    return [
        CheckResult("files", FAILURE, f"{name}: no file {value}", _PATH_CURE)
        for name, entry in plan.nodes.items()
        for value in _paths(plan.documents[name].data, _UNREAD.get(entry.module, ()))
        if value not in known and not Path(value).exists()
    ]


def _attacks(plan: Plan) -> list[CheckResult]:
    """Check the attacks that nodes name."""
    found: list[CheckResult] = []
    for name in plan.nodes:
        data = plan.documents[name].data
        if isinstance(data, dict) and data.get("attack"):
            found += _attack(name, data)
    return found


def _margins(plan: Plan) -> list[CheckResult]:
    """Check that the safety node's margin leaves the start of the room inside the fence."""
    found: list[CheckResult] = []
    for name in (name for name, entry in plan.nodes.items() if entry.module == _SAFETY):
        try:
            config = validate(SafetyConfig, plan.documents[name])
            room = load_calibration(RoomCalibration, config.room)
        except AdvnerfError:
            continue  # reported under "nodes" or "calibration"
        try:
            config.limits(room)
        except AdvnerfError as error:
            found += report("fence", FAILURE, f"{name}: {error}", "correct the launch file or the room")
    return found


def _line(row: CheckResult) -> str:
    return " ".join(f"{row.found}; {row.do}".split())


def _paths(value: Any, unread: Sequence[str] = ()) -> Iterator[str]:
    if isinstance(value, dict):
        for key, item in value.items():
            if key not in unread and (key != "attack" or not isinstance(item, str)):  # see _attack
                yield from _paths(item)
    elif isinstance(value, list):
        for item in value:
            yield from _paths(item)
    elif isinstance(value, str) and value.endswith(_FILES) and not value.startswith("<"):
        yield value


def _panel(target: TargetCalibration, size_mm: Any) -> MonitorPanel:
    """A monitor's panel; its pixels say nothing about whether an attack fits."""
    size_m = target_size(target) if size_mm is None else (size_mm[0] / 1000.0, size_mm[1] / 1000.0)
    return MonitorPanel((1000, 1000), size_m)


def _attack(name: str, data: dict[str, Any]) -> list[CheckResult]:
    file = Path(data["attack"])
    if not file.exists():
        return report("attack", FAILURE, f"{name}: no file {file}", _PATH_CURE)
    try:
        attack = load_attack(file)
    except AdvnerfError as error:
        return report("attack", FAILURE, str(error), "run the attack again, or name another file")
    try:
        target = load_calibration(TargetCalibration, data["target"]) if "target" in data else None
        camera = load_calibration(CameraCalibration, data["camera"]) if "camera" in data else None
    except CalibrationError:
        target = None  # reported under "calibration"
    try:
        if target is not None and camera is not None:
            show(attack, camera, target)
        elif target is not None:
            require_fits(attack, _panel(target, data.get("size_mm")), target)
    except AdvnerfError as error:
        return report("attack", FAILURE, f"{name}: {error}", "give the target that it was made for")
    subject = "no subject" if attack.face is None else attack.face.subject
    return report("attack", OK, f"{name}: {attack.attack_id}, {attack.method}, for {subject}")
