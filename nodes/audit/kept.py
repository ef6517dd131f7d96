"""Stored drives of an audit, from which its numbers can be recomputed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.driving.metrics import Horizon, drive_metrics
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_atomically
from advnerf_core.report.audit_result import AuditedDrives, AuditResult, Control, read_audit
from hardware.worlds.paths import ReferencePath
from nodes.audit.drives import FOUND, FOUND_DISTURBED, PLAIN_DISTURBED
from nodes.audit.judging import CONTROLS, Judged
from nodes.audit.verdict import ArmDrives, effect_of, judge
from nodes.lab.worlds.expert_drive import as_path

DRIVES, RESULT = "drives.json", "audit.json"
# Numbers must agree to this [m]: they come from the same states.
_SAME_M = 1e-6


class AuditDiffersError(AdvnerfError):
    """An audit's numbers differ from those of its drives."""


def keep_drives(folder: Path, judged: Sequence[Judged]) -> None:
    """Write the states of all judged drives, with their path and horizon."""
    data = {each.evidence: _as_data(each) for each in judged}
    write_atomically(folder / DRIVES, json.dumps(data) + "\n")


def _as_data(judged: Judged) -> dict[str, Any]:
    experiment = judged.experiment
    limits = experiment.limits
    return {
        "path": experiment.references[experiment.config.paths[0]].to_dict(),
        "limits": {"ticks": limits.ticks, "dt_s": limits.dt_s, "held_cap_m": limits.held_cap_m},
        "off_track_m": judged.limit_m,
        "states": {name: drives.states.tolist() for name, drives in judged.drives.items()},
        "driven_ticks": {name: drives.driven_ticks.tolist() for name, drives in judged.drives.items()},
    }


def read_drives(folder: Path) -> dict[str, dict[str, ArmDrives]]:
    """The judged drives by evidence and arm, measured again."""
    return {evidence: _measured(data) for evidence, data in read_json(folder / DRIVES).items()}


def _measured(data: Mapping[str, Any]) -> dict[str, ArmDrives]:
    path = as_path(ReferencePath.from_dict(data["path"]))
    horizon = Horizon(off_track_m=data["off_track_m"], **data["limits"])
    found = {}
    for name, listed in data["states"].items():
        states, ticks = np.array(listed), np.array(data["driven_ticks"][name])
        scores = [
            drive_metrics(path, each[: 1 + driven], horizon)
            for each, driven in zip(states, ticks, strict=True)
        ]
        found[name] = ArmDrives.of(states, scores, ticks)
    return found


def check_audit(folder: Path) -> list[str]:
    """Recompute an audit's numbers from the drives in its folder; returns the checks, a line each.

    Raises:
        AuditDiffersError: A number differs.
    """
    result = read_audit(folder / RESULT)
    if result.strongest is None:
        return [f"{folder}: {result.verdict.outcome}, nothing was judged"]
    drives = read_drives(folder)
    return [_check(folder, result, each, drives[each.evidence]) for each in result.strongest.judgements]


def _check(folder: Path, result: AuditResult, said: AuditedDrives, drives: Mapping[str, ArmDrives]) -> str:
    limit_m = result.place.off_track_m
    assert limit_m is not None, "an object is judged where the scale is known"
    controls: dict[Control, ArmDrives] = {name: drives[name] for name in CONTROLS}
    found = judge(drives[FOUND], controls, limit_m)
    _same(folder, f"{said.evidence}: control", said.control, found.control)
    for name in ("mean_m", "low_m", "high_m"):
        _same(
            folder, f"{said.evidence}: effect.{name}", getattr(said.effect, name), getattr(found.effect, name)
        )
    rows = zip(said.starts, drives[FOUND].largest_m, controls[found.control].largest_m, strict=True)
    for number, (start, largest_m, control_m) in enumerate(rows):
        where = f"{said.evidence}: start {number}"
        _same(folder, f"{where}: off_path_m", start.off_path_m, float(largest_m))
        _same(folder, f"{where}: control_off_path_m", start.control_off_path_m, float(control_m))
        _same(folder, f"{where}: off_track", start.off_track, bool(largest_m > limit_m))
    if said.disturbed is not None:
        worse, plain = drives[FOUND_DISTURBED], drives[PLAIN_DISTURBED]
        where = f"{said.evidence}: disturbed"
        _same(folder, f"{where}.effect.mean_m", said.disturbed.effect.mean_m, effect_of(worse, plain).mean_m)
        _same(folder, f"{where}.off_track", said.disturbed.off_track, int(worse.left(limit_m).sum()))
    if said.evidence == result.verdict.evidence and result.verdict.outcome in ("found", "nothing_found"):
        _same(folder, "verdict", result.verdict.outcome, "found" if found.found else "nothing_found")
    return f"{folder}: {said.evidence}, {len(said.starts)} starts: as the drives say"


def _same(folder: Path, what: str, said: Any, computed: Any) -> None:
    alike = (
        abs(said - computed) <= _SAME_M
        if isinstance(said, float) and isinstance(computed, float)
        else said == computed
    )
    if not alike:
        raise AuditDiffersError(
            f"{folder / RESULT}: {what}: expected {computed} from the kept drives, got {said}"
        )
