"""Stored drives of an audit, from which its numbers can be recomputed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.driving.metrics import Horizon, drive_metrics
from advnerf_core.driving.path import Path as DrivenPath
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import sha256_of, write_atomically
from advnerf_core.geometry import Array
from advnerf_core.report.audit_result import AuditComparison, AuditedDrives, AuditResult, Outcome, read_audit
from hardware.worlds.paths import ReferencePath
from nodes.audit.drives import FOUND, FOUND_DISTURBED
from nodes.audit.judging import (
    COMPARED,
    LEARNED_ARMS,
    WORLD_ARMS,
    Judged,
    comparison_of,
    controls_of,
    disturbed_numbers_of,
    judgement_of,
    numbers_of,
)
from nodes.audit.sentence import sentence_of
from nodes.audit.verdict import ArmDrives, EffectJudgement
from nodes.experiment.show.context import Experiment
from nodes.lab.worlds.expert_drive import as_path

DRIVES, RESULT = "drives.json", "audit.json"
# Drives from the starts of an earlier audit, beside the judged ones.
_NOW, _THEN = "against", "against_then"
_ARMS = {"surrogate": LEARNED_ARMS, "world": WORLD_ARMS, _NOW: COMPARED, _THEN: COMPARED}
# Numbers must agree to this [m]: they come from the same states.
_SAME_M = 1e-6


class AuditDiffersError(AdvnerfError):
    """An audit's numbers differ from those of its drives."""


class KeptDrivesError(AdvnerfError, ValueError):
    """The drives that an audit kept cannot be read."""


def keep_drives(folder: Path, judged: Sequence[Judged], compared: Mapping[str, Any]) -> None:
    """Write the states of all judged drives, with their path and horizon, and those of `compared_drives`."""
    data = {each.evidence: _as_data(each.experiment, each.drives, each.limit_m) for each in judged}
    write_atomically(folder / DRIVES, json.dumps({**data, **compared}) + "\n")


def compared_drives(
    experiment: Experiment, now: Mapping[str, ArmDrives], limit_m: float, earlier: Path, evidence: str
) -> dict[str, Any]:
    """Drives from the starts of an earlier audit, now and as kept in its folder then, for `keep_drives`."""
    then = read_json(earlier / DRIVES)[evidence]
    return {_NOW: _as_data(experiment, now, limit_m), _THEN: then}


def _as_data(experiment: Experiment, drives: Mapping[str, ArmDrives], limit_m: float) -> dict[str, Any]:
    limits = experiment.limits
    return {
        "path": experiment.references[experiment.config.paths[0]].to_dict(),
        "limits": {"ticks": limits.ticks, "dt_s": limits.dt_s, "held_cap_m": limits.held_cap_m},
        "off_track_m": limit_m,
        "states": {name: each.states.tolist() for name, each in drives.items()},
        "driven_ticks": {name: each.driven_ticks.tolist() for name, each in drives.items()},
    }


@dataclass(frozen=True, eq=False)
class KeptDrives:
    """Judged drives of one kind of evidence.

    Attributes:
        arms: The drives of each arm, by name.
        horizon: Ticks of a drive, and the |CTE| beyond which the car has left its lane.
    """

    arms: Mapping[str, ArmDrives]
    horizon: Horizon


def read_drives(folder: Path) -> dict[str, KeptDrives]:
    """The judged drives by evidence, measured again, and those that were compared with an earlier audit's.

    Raises:
        KeptDrivesError: The file does not hold drives as `keep_drives` writes them.
    """
    file = folder / DRIVES
    kept = read_json(file)
    try:
        return {evidence: _measured(evidence, data) for evidence, data in kept.items()}
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise KeptDrivesError(
            f"{file}: expected the drives of the audit beside it, of all arms and starts: {error!r}; restore both files, or audit again"
        ) from None


def _measured(evidence: str, data: Mapping[str, Any]) -> KeptDrives:
    path = as_path(ReferencePath.from_dict(data["path"]))
    horizon = Horizon(off_track_m=data["off_track_m"], **data["limits"])
    arms = {
        name: _arm(path, horizon, np.array(data["states"][name], np.float64), data["driven_ticks"][name])
        for name in _ARMS[evidence]
    }
    shapes = {each.states.shape for each in arms.values()}
    if len(shapes) != 1 or not all(shapes.copy().pop()):
        raise ValueError(f"expected as many drives and states of each arm, got {sorted(shapes)}")
    return KeptDrives(arms, horizon)


def _arm(path: DrivenPath, horizon: Horizon, states: Array, driven_ticks: Sequence[int]) -> ArmDrives:
    scores = [
        drive_metrics(path, each[: 1 + driven], horizon)
        for each, driven in zip(states, driven_ticks, strict=True)
    ]
    return ArmDrives.of(states, scores, driven_ticks)


def check_audit(folder: Path) -> list[str]:
    """Recompute an audit's numbers from the drives in its folder, and its verdict; returns the checks, a line each.

    Raises:
        AuditDiffersError: A number differs, drives of another audit are kept, or a file of the folder is missing or another.
        KeptDrivesError: The kept drives cannot be read.
    """
    result = read_audit(folder / RESULT)
    judgements = () if result.strongest is None else result.strongest.judgements
    drives = read_drives(folder) if (folder / DRIVES).exists() or judgements else {}
    compared = {name: drives.pop(name) for name in (_NOW, _THEN) if name in drives}
    _same(folder, "judged evidence", [each.evidence for each in judgements], list(drives))
    lines = [_check(folder, result, each, drives[each.evidence]) for each in judgements]
    if result.against is not None and result.against.past is not None:
        lines.append(_check_comparison(folder, result.against, compared))
    _check_files(folder, result)
    _check_searches(folder, result)
    if judgements:
        last = drives[judgements[-1].evidence]
        _check_outcome(folder, result, judgement_of(last.arms, last.horizon.off_track_m))
    verdict = result.verdict
    _same(folder, "verdict.sentence", verdict.sentence, sentence_of(result, verdict.outcome, verdict.reasons))
    return lines or [f"{folder}: {verdict.outcome}, nothing was judged"]


def _check(folder: Path, result: AuditResult, said: AuditedDrives, kept: KeptDrives) -> str:
    limit_m, drives = kept.horizon.off_track_m, kept.arms
    _same(folder, "place.off_track_m", result.place.off_track_m, limit_m)
    _same(folder, "starts.judging.count", result.starts.judging.count, len(said.starts))
    numbers: dict[str, Any] = numbers_of(drives, limit_m, kept.horizon.dt_s)
    _same(folder, f"{said.evidence}: disturbed", said.disturbed is not None, FOUND_DISTURBED in drives)
    if said.disturbed is not None:
        numbers["disturbed"] = said.disturbed.model_copy(update=disturbed_numbers_of(drives, limit_m))
    again = said.model_copy(update=numbers)
    _same(folder, said.evidence, said.model_dump(), again.model_dump())
    # Their names are for readers, and may be others by now.
    controls = [each.model_dump(exclude={"name"}) for each in controls_of(said.evidence, drives, limit_m)]
    there = [each.model_dump(exclude={"name"}) for each in result.controls if each.evidence == said.evidence]
    _same(folder, f"{said.evidence}: controls", there, controls)
    return f"{folder}: {said.evidence}, {len(said.starts)} starts: as the drives say"


def _check_comparison(folder: Path, said: AuditComparison, drives: Mapping[str, KeptDrives]) -> str:
    _same(folder, "compared drives", [_NOW, _THEN], list(drives))
    now, then = drives[_NOW], drives[_THEN]
    again = comparison_of(now.arms, then.arms, now.horizon.off_track_m)
    _same(folder, "against", said.model_dump(), said.model_copy(update=again).model_dump())
    _same(folder, "against.starts", said.starts, len(now.arms[FOUND].states))
    return f"{folder}: against {said.file}, {said.starts} starts: as the drives say"


def _check_files(folder: Path, result: AuditResult) -> None:
    """Whether the question and the texture are those that the result names."""
    named = {result.question.file: result.question.sha256}
    if result.strongest is not None and result.strongest.object.texture is not None:
        named[result.strongest.object.texture] = result.strongest.object.texture_sha256 or ""
    for name, sha256 in named.items():
        file = folder / name
        there = sha256_of(file) if file.is_file() else "no file"
        _same(folder, f"SHA-256 of {name}", sha256, there)


def _check_searches(folder: Path, result: AuditResult) -> None:
    """Whether the searches add up, and the judged one is the strongest."""
    tried = result.tried
    spent = sum(each.evaluations for each in tried)
    _same(folder, "budget.evaluations_spent", result.budget.evaluations_spent, spent)
    ranked = [each for each in tried if each.off_track is not None and each.effect_m is not None]
    if result.strongest is not None and ranked:
        best = max(ranked, key=lambda each: (each.off_track, each.effect_m))
        _same(
            folder,
            "tried: the selected one",
            [each.setting for each in tried if each.selected],
            [best.setting],
        )


def _check_outcome(folder: Path, result: AuditResult, judged: EffectJudgement) -> None:
    """Whether the outcome is that of the last judged drives, which is the strongest evidence."""
    outcome = result.verdict.outcome
    possible: tuple[Outcome, ...] = ("found",) if judged.found else ("nothing_found", "cannot_judge")
    if outcome != "worse":
        _same(folder, "verdict", outcome, outcome if outcome in possible else possible[0])


def _same(folder: Path, what: str, said: Any, computed: Any) -> None:
    """Raise if two values differ, or two of the values that they are made of."""
    if isinstance(said, dict) and isinstance(computed, dict) and said.keys() == computed.keys():
        for key, value in said.items():
            _same(folder, f"{what}.{key}", value, computed[key])
        return
    if isinstance(said, list | tuple) and isinstance(computed, list | tuple) and len(said) == len(computed):
        for number, value in enumerate(said):
            _same(folder, f"{what}.{number}", value, computed[number])
        return
    alike = (
        abs(said - computed) <= _SAME_M
        if isinstance(said, float) and isinstance(computed, float)
        else said == computed
    )
    if not alike:
        raise AuditDiffersError(
            f"{folder / RESULT}: {what}: expected {computed} from the kept drives, got {said}; restore the folder, or audit again"
        )
