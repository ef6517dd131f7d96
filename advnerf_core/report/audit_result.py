"""The result of an audit: can an object drive this policy off its path at this place?

An audit writes one `AuditResult` as JSON. The page, the OpenSCENARIO, SARIF and JUnit files are made from it, and
``advnerf audit --schema`` prints its JSON schema. `advnerf_core/report/audit_parts.py` holds the frames and units.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AwareDatetime, Field, model_validator

from advnerf_core.documents import Document, read_json
from advnerf_core.files import write_json
from advnerf_core.report.audit_parts import (
    AuditedDrives,
    AuditedPlace,
    AuditedPolicy,
    AuditedVehicle,
    AuditEffect,
    AuditQuestion,
    Evidence,
    JudgedObject,
    NotNegative,
    Positive,
    Sha256,
    Text,
)
from advnerf_core.strict import StrictModel, validate

FORMAT: Literal["advnerf-audit-1"] = "advnerf-audit-1"
Outcome = Literal["nothing_found", "found", "cannot_judge", "worse"]
EXIT_CODES: dict[Outcome, int] = {"nothing_found": 0, "found": 1, "cannot_judge": 2, "worse": 3}

ControlKind = Literal["no_object", "plain_object", "natural_picture"]
Count = Annotated[int, Field(ge=0)]


class AuditControl(StrictModel):
    """Drives without an attack, or past an object without a search."""

    kind: ControlKind
    name: Text = Field(description="For readers: no object, grey panel, photograph of leaves.")
    evidence: Evidence
    mean_off_path_m: NotNegative | None = Field(
        description="Mean over the starts [m]; null without a known scale."
    )
    off_track: Count
    starts: Annotated[int, Field(ge=1)]


class PlantedControl(StrictModel):
    """A victim that is known to be attackable, audited in the same place with the same budget."""

    name: Text
    found: bool
    evaluations: Count
    effect_m: float | None = Field(default=None, description="On its selection starts [m].")


class TriedSearch(StrictModel):
    """One search that was run."""

    object: Text
    placement: Text
    space: Text
    method: Text
    seed: int = 0
    evaluations: Count
    effect_m: float | None = Field(
        description="Mean effect on the selection starts [m]; null if it was not selected from."
    )
    selected: bool = Field(default=False, description="Whether it was driven from the judging starts.")


class NotTried(StrictModel):
    """An item of the schedule that the audit did not try."""

    what: Text
    why: Text


class AuditFidelity(StrictModel):
    """Agreement of the learned copy of the place with images that were held out from learning."""

    views: Count
    psnr_db: float
    ssim: float | None = None
    steering_difference: NotNegative = Field(
        description="Mean |steering on the learned minus on the real image| [rad]; of a turn rate [rad/s]."
    )
    halves_agree: bool | None = Field(
        default=None,
        description="Whether a copy learned from the other half of the images agrees; null if none was learned.",
    )
    trusted: bool
    why: tuple[Text, ...] = Field(default=(), description="Limits that were missed; empty if it is trusted.")

    @model_validator(mode="after")
    def _has_reasons(self) -> AuditFidelity:
        if self.trusted == bool(self.why):
            raise ValueError("expected reasons in why exactly if trusted is false")
        return self


class StartSet(StrictModel):
    """Starts drawn from a seed."""

    seed: int
    count: Annotated[int, Field(ge=1)]


class AuditStarts(StrictModel):
    """The three disjoint sets of starts, fixed before the first drive."""

    search: StartSet
    selection: StartSet
    judging: StartSet

    @model_validator(mode="after")
    def _disjoint(self) -> AuditStarts:
        seeds = (self.search.seed, self.selection.seed, self.judging.seed)
        if len(set(seeds)) < len(seeds):
            raise ValueError(f"expected different seeds for search, selection and judging, got {seeds}")
        return self


class AuditBudget(StrictModel):
    """Planned and spent evaluations; an evaluation is one drive."""

    evaluations_planned: Count
    evaluations_spent: Count
    minutes: Positive | None = Field(
        default=None, description="For the whole audit, as the user gave it; converted into evaluations once."
    )
    seconds: NotNegative | None = Field(
        description="Time that the audit took [s]; null where the same audit is to give the same bytes."
    )
    ended: Literal["schedule", "budget", "interrupted"]


class AuditComparison(StrictModel):
    """The difference to an earlier audit, over the starts that both judged."""

    file: Text
    sha256: Sha256
    effect: AuditEffect = Field(description="AuditEffect now minus effect then.")
    margin_m: NotNegative = Field(description="A lower end above this is worse [m].")
    starts: Annotated[int, Field(ge=2)]


class AuditVerdict(StrictModel):
    """The conclusion of the audit."""

    outcome: Outcome = Field(
        description="The command's exit code is 0, 1, 2 or 3 in this order: nothing_found, found, cannot_judge, worse."
    )
    evidence: Evidence | None = Field(
        description="The strongest evidence that was judged; null if the audit cannot judge."
    )
    sentence: Text = Field(description="The verdict in one sentence, for readers.")
    reasons: tuple[Text, ...] = Field(default=(), description="Why the audit cannot judge; empty if it can.")

    @model_validator(mode="after")
    def _has_reasons(self) -> AuditVerdict:
        cannot = self.outcome == "cannot_judge"
        if cannot != bool(self.reasons) or (not cannot and self.evidence is None):
            raise ValueError(
                "expected reasons exactly for cannot_judge, and evidence for every other outcome"
            )
        return self


class AuditResult(StrictModel):
    """The complete result of an audit."""

    format: Literal["advnerf-audit-1"] = FORMAT
    verdict: AuditVerdict
    policy: AuditedPolicy
    place: AuditedPlace
    vehicle: AuditedVehicle | None
    strongest: JudgedObject | None = Field(default=None, description="Null if no object was judged.")
    controls: tuple[AuditControl, ...] = ()
    planted: PlantedControl | None = Field(default=None, description="Null if the audit ended before it.")
    tried: tuple[TriedSearch, ...] = ()
    not_tried: tuple[NotTried, ...] = ()
    fidelity: AuditFidelity | None = Field(
        default=None, description="Null if no copy of the place was learned."
    )
    starts: AuditStarts
    budget: AuditBudget
    against: AuditComparison | None = None
    question: AuditQuestion
    versions: dict[str, str] = Field(
        description="Version of each program that a number depends on, by its name."
    )
    date: AwareDatetime | None = Field(
        description="When it ended, ISO 8601 with time zone; null where the same audit is to give the same bytes."
    )

    @model_validator(mode="after")
    def _is_consistent(self) -> AuditResult:
        for wrong in _contradictions(self):
            raise ValueError(wrong)
        return self

    @property
    def exit_code(self) -> int:
        """Exit code of the command."""
        return EXIT_CODES[self.verdict.outcome]

    @property
    def judgement(self) -> AuditedDrives | None:
        """The judgement behind the verdict; None if no object was judged."""
        judged = self.strongest.judgements if self.strongest else ()
        return next((each for each in judged if each.evidence == self.verdict.evidence), None)


def _contradictions(result: AuditResult) -> list[str]:
    """Conclusions that the rest of the result does not support."""
    outcome, evidence = result.verdict.outcome, result.verdict.evidence
    concluded = outcome != "cannot_judge"
    trusted = result.fidelity is not None and result.fidelity.trusted
    planted = result.planted is not None and result.planted.found
    checks = (
        (
            result.place.scale is not None or result.strongest is None,
            "a judged object needs a known scale of the place",
        ),
        (
            outcome != "found" or result.judgement is not None,
            "found needs a judgement with the verdict's evidence",
        ),
        (outcome != "worse" or result.against is not None, "worse needs the comparison in against"),
        (
            not concluded or evidence != "surrogate" or trusted,
            "a verdict with surrogate evidence needs a trusted fidelity",
        ),
        (outcome != "nothing_found" or planted, "nothing_found needs a planted control that was found"),
    )
    return [f"expected a consistent result: {text}" for holds, text in checks if not holds]


def audit_schema() -> dict[str, Any]:
    """The JSON schema of an audit's result."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **AuditResult.model_json_schema()}


def read_audit(file: Path) -> AuditResult:
    """The result of an audit in a JSON file.

    Raises:
        ConfigError: The file does not contain one; a line for each wrong key.
    """
    return validate(AuditResult, Document(read_json(file), str(file)))


def write_audit(file: Path, result: AuditResult) -> None:
    """Write the result of an audit as JSON."""
    write_json(file, result.model_dump(mode="json"))
