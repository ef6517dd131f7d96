"""The result of an audit from its findings: the sentence, the numbers behind it, and the files of its folder."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from advnerf_core.data.image_files import write_image
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import sha256_of, write_atomically
from advnerf_core.policies.load import is_code, source_sha256
from advnerf_core.report.audit_result import (
    AuditBudget,
    AuditComparison,
    AuditedObject,
    AuditedPlace,
    AuditedPolicy,
    AuditedVehicle,
    AuditFidelity,
    AuditQuestion,
    AuditResult,
    AuditStarts,
    AuditVerdict,
    Evidence,
    JudgedObject,
    NotTried,
    Outcome,
    PlacedPose,
    PlantedControl,
    StartSet,
    TriedSearch,
    write_audit,
)
from nodes.audit.comparing import ATTACK_KEPT
from nodes.audit.judging import Judged, film, texture_of
from nodes.audit.kept import RESULT, keep_drives
from nodes.audit.page import write_page
from nodes.audit.question import JUDGING_SEED, SELECTION_SEED, SELECTION_STARTS, VICTIM, AuditedQuestion
from nodes.audit.schedule import NEVER_TRIED
from nodes.audit.searching import ZERO_GRADIENT, FoundAttack, Searches
from nodes.audit.sentence import sentence_of
from nodes.audit.spots import Spot
from nodes.experiment.plan.object_kinds import extent_m, name_of
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import given_victim
from nodes.runtime.progress import Report

TEXTURE, BEFORE, AFTER, FILM = "object.png", "before.png", "after.png", "drives.mp4"
PICTURES = {
    BEFORE: "Where it stands, in plain colours, before any search: as the learned place shows it where it is largest.",
    AFTER: "The same with what was found.",
    TEXTURE: "What was found, from the front.",
}
_LIBRARIES = ("torch", "numpy", "numba", "opencv-contrib-python-headless")


@dataclass
class Known:
    """All findings of a running audit; None or empty for steps that were not reached."""

    question: AuditedQuestion
    minutes: float | None
    file: Path | None = None
    experiment: Experiment | None = None
    fidelity: AuditFidelity | None = None
    spots: Sequence[Spot] = ()
    searches: Searches | None = None
    best: FoundAttack | None = None
    judged: list[Judged] = field(default_factory=list)
    planted: PlantedControl | None = None
    against: AuditComparison | None = None
    compared: dict[str, Any] = field(default_factory=dict)
    reasons: tuple[str, ...] = ()
    interrupted: bool = False
    seconds: float | None = None
    ended: datetime | None = None

    @property
    def limit_m(self) -> float:
        """|CTE| beyond which the car has left its lane [m]."""
        assert self.experiment is not None, "the place is described before anything is judged by it"
        return self.question.limit_m or self.experiment.world.off_track_m


def result_of(known: Known, folder: Path) -> AuditResult:
    """The result of an audit; the pictures that it names are written into its folder."""
    facts = _facts(known, folder)
    outcome = _outcome(known)
    reasons = known.reasons if outcome == "cannot_judge" else ()
    verdict = AuditVerdict(
        outcome=outcome,
        evidence=_evidence(known, outcome),
        sentence=sentence_of(AuditResult.model_construct(**facts), outcome, reasons),
        reasons=reasons,
    )
    return AuditResult(verdict=verdict, **facts)


def _outcome(known: Known) -> Outcome:
    if known.against is not None and known.against.is_worse:
        return "worse"
    if known.reasons:
        return "cannot_judge"
    return "found" if known.judged[-1].judgement.found else "nothing_found"


def _evidence(known: Known, outcome: Outcome) -> Evidence | None:
    if outcome == "cannot_judge":
        return None
    return known.question.place.evidence if outcome == "worse" else known.judged[-1].evidence


def _facts(known: Known, folder: Path) -> dict[str, Any]:
    """All fields of the result but the verdict."""
    assert known.file is not None, "the experiment file is written first"
    question = known.question
    return dict(
        policy=AuditedPolicy(path=question.given, sha256=_sha256_of(known)),
        place=AuditedPlace(
            name=question.place.name,
            kind=question.place.kind,
            source=question.place.source,
            scale=question.place.scale,
            off_track_m=None if known.experiment is None else known.limit_m,
        ),
        vehicle=_vehicle(known),
        strongest=_strongest(known, folder),
        controls=tuple(control for each in known.judged for control in each.controls()),
        planted=known.planted,
        tried=tuple(_tried(known)),
        not_tried=tuple(_not_tried(known)),
        fidelity=known.fidelity,
        starts=AuditStarts(
            search=StartSet(seed=0, count=_search_starts(known)),
            selection=StartSet(seed=SELECTION_SEED, count=SELECTION_STARTS),
            judging=StartSet(seed=JUDGING_SEED, count=question.judging),
        ),
        budget=_budget(known),
        against=known.against,
        question=AuditQuestion(file=known.file.name, sha256=sha256_of(known.file)),
        versions={
            "advnerf": version("advnerf"),
            "python": platform.python_version(),
            **{name: version(name) for name in _LIBRARIES},
        },
        date=known.ended,
    )


def write_result(known: Known, result: AuditResult, folder: Path, report: Report) -> str:
    """Write the result and its derived files: the drives, the film, the page; returns failed files, and why."""
    _remove_earlier(known, folder)
    keep_drives(folder, known.judged, known.compared)
    if known.best is not None:
        write_atomically(folder / ATTACK_KEPT, known.best.attack.read_bytes())
    shown = film(known.judged[-1], folder / FILM, report) if known.judged else None
    path = None
    if known.experiment is not None and known.judged:
        path = known.experiment.paths[known.experiment.config.paths[0]]
    pictures = [(folder / name, caption) for name, caption in PICTURES.items() if (folder / name).exists()]
    drives = {each.evidence: each.drives for each in known.judged}
    write_page(folder, result, drives, path, shown, pictures)
    write_audit(folder / RESULT, result)
    try:
        from advnerf_core.report.exports.write import write_exports
    except ImportError:  # the extra is for users who pass results to other programs
        return "for SARIF, JUnit and OpenSCENARIO files: pip install 'advnerf[audit]', then the same command again"
    write_exports(folder, result)
    return ""


def _remove_earlier(known: Known, folder: Path) -> None:
    """Remove files of an earlier run in this folder that this one did not come to: they would be shown as its finding."""
    gone = [] if known.spots else [BEFORE]
    gone += [] if known.best is not None else [TEXTURE, AFTER, ATTACK_KEPT]
    gone += [] if known.judged else [FILM]
    for name in gone:
        (folder / name).unlink(missing_ok=True)


def _strongest(known: Known, folder: Path) -> JudgedObject | None:
    if known.best is None or not known.judged:
        return None
    placed, texture = known.spots[known.best.spot].placed, texture_of(known.best.attack)
    if texture is not None:
        write_image(folder / TEXTURE, texture)
    length, width, height = (placed.scale * each for each in extent_m(placed.kind))
    return JudgedObject(
        object=AuditedObject(
            name=placed.name,
            kind=name_of(placed.kind),
            size_m=(length, width, height),
            pose=PlacedPose(x_m=placed.x_m, y_m=placed.y_m, z_m=placed.z_m, yaw_rad=placed.yaw_rad),
            texture=None if texture is None else TEXTURE,
            texture_sha256=None if texture is None else sha256_of(folder / TEXTURE),
        ),
        judgements=tuple(each.as_result() for each in known.judged),
    )


def _vehicle(known: Known) -> AuditedVehicle | None:
    if known.experiment is None or known.experiment.car.wheelbase_m is None:
        return None
    car = known.experiment.car
    assert car.wheelbase_m is not None
    return AuditedVehicle(
        name="car", wheelbase_m=car.wheelbase_m, speed_mps=car.speed_mps, max_steering_rad=car.largest_control
    )


def _tried(known: Known) -> Iterator[TriedSearch]:
    for each in known.searches.found if known.searches else ():
        yield TriedSearch(
            object=name_of(known.question.kind),
            placement=f"spot {each.spot + 1}",
            space="colours",
            method=each.method,
            seed=each.seed,
            setting=each.setting,
            evaluations=each.evaluations,
            effect_m=each.effect_m,
            off_track=each.left,
            selected=each is known.best,
        )


def _not_tried(known: Known) -> Iterator[NotTried]:
    yield from (NotTried(what=what, why=why) for what, why in NEVER_TRIED.items())
    if known.searches is None:
        return
    flat = known.searches.flat
    done = {each.setting for each in known.searches.found}
    for number, (wanted, row) in enumerate(
        zip(known.searches.rounds, known.searches.planned, strict=True), start=1
    ):
        begun, zero = (sum(name.startswith(f"{number}-") for name in names) for names in (done, flat))
        if zero:
            yield NotTried(what=f"{zero} searches by {wanted.method} (round {number})", why=ZERO_GRADIENT)
        left = len(row) - begun - zero
        if left > 0:
            why = "interrupted" if known.interrupted else "the audit ended before it"
            yield NotTried(what=f"{left} searches by {wanted.method} (round {number})", why=why)


def _search_starts(known: Known) -> int:
    return max(each.starts for each in known.searches.rounds) if known.searches else 1


def _budget(known: Known) -> AuditBudget:
    searches = known.searches
    return AuditBudget(
        evaluations_planned=searches.cost if searches else 0,
        evaluations_spent=sum(each.evaluations for each in searches.found) if searches else 0,
        minutes=known.minutes,
        seconds=None if known.seconds is None else round(known.seconds, 1),
        ended="interrupted" if known.interrupted else "schedule",
    )


def _sha256_of(known: Known) -> str | None:
    """Content hash of the policy; of code, with the versions and the answers by which it was told apart when it was looked at."""
    policy = known.question.policy
    try:
        if is_code(policy) and known.experiment is not None:
            return given_victim(known.experiment, VICTIM).sha256
        return source_sha256(policy)
    except (AdvnerfError, OSError):
        return None
