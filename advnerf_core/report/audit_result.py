"""The result of an audit: can an object drive this policy off its path at this place?

An audit writes one `AuditResult` as JSON. The page, the OpenSCENARIO, SARIF and JUnit files are made from it, and
``advnerf audit --schema`` prints its JSON schema.

Distances are in metres and angles in radians, in the world frame of the place (z up). A vehicle's pose is its rear axle's
centre on the ground.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import AwareDatetime, Field, model_validator

from advnerf_core.documents import Document, read_json
from advnerf_core.files import write_json
from advnerf_core.strict import StrictModel, validate

FORMAT: Literal["advnerf-audit-1"] = "advnerf-audit-1"
Outcome = Literal["nothing_found", "found", "cannot_judge", "worse"]
EXIT_CODES: dict[Outcome, int] = {"nothing_found": 0, "found": 1, "cannot_judge": 2, "worse": 3}
Evidence = Literal["surrogate", "world", "live"]
_EVIDENCE: tuple[Evidence, ...] = get_args(Evidence)  # from the weakest to the strongest
PlaceKind = Literal["images", "video", "scene", "splat", "world"]
Scale = Literal["world", "poses", "length", "positions", "fiducials"]
Control = Literal["no_object", "plain_object"]
ControlKind = Literal["no_object", "plain_object", "natural_picture"]

Text = Annotated[str, Field(min_length=1)]
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(gt=0.0, lt=1.0)]
Count = Annotated[int, Field(ge=0)]
# Stored means must equal those of the stored drives up to this [m]; both come from the same numbers.
_ROUNDING_M = 1e-6


class AuditQuestion(StrictModel):
    """The resolved experiment file that the audit ran."""

    file: Text = Field(description="Name of the file in the audit's folder.")
    sha256: Sha256


class AuditedPolicy(StrictModel):
    """The policy that was audited."""

    path: Text = Field(description="File, module:factory or address, as the user gave it.")
    sha256: Sha256 | None = Field(description="Of the file; null for a policy without one.")


class AuditedPlace(StrictModel):
    """The place of the audit."""

    name: Text = Field(description="As sentences name it: MetaDrive, the hall.")
    kind: PlaceKind
    source: Text = Field(description="Folder, file or name of the world, as the user gave it.")
    scale: Scale | None = Field(
        description="What the metre comes from; null if nothing tells it. Then the result holds no effect."
    )
    off_track_m: Positive | None = Field(
        description="|CTE| beyond which the vehicle has left its lane [m]; null without a known scale."
    )
    road_network: Text | None = Field(
        default=None, description="OpenDRIVE file of the place; null if it has none."
    )


class AuditedVehicle(StrictModel):
    """The vehicle that the policy drives. Sizes that the audit did not need are null."""

    name: Text
    wheelbase_m: Positive
    speed_mps: Positive = Field(description="Speed at which it was driven [m/s].")
    max_steering_rad: Positive | None = None
    length_m: Positive | None = None
    width_m: Positive | None = None
    height_m: Positive | None = None


class PlacedPose(StrictModel):
    """Position of an object's origin [m] and its attitude [rad], yaw then pitch then roll about z, y and x."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    pitch_rad: float = 0.0
    roll_rad: float = 0.0


class AuditedObject(StrictModel):
    """An object that was placed."""

    name: Text
    kind: Text = Field(description="panel, cube, billboard, mesh or another kind.")
    size_m: tuple[Positive, Positive, Positive] = Field(
        description="Extent along the object's own x (depth), y (width) and z (height) [m]; its origin is the middle of its foot."
    )
    pose: PlacedPose
    texture: Text | None = Field(description="Picture in the audit's folder; null if it has none.")
    texture_sha256: Sha256 | None = None
    model: Text | None = Field(default=None, description="GLB file in the audit's folder.")


class RoutePoint(StrictModel):
    """Pose of the vehicle at a time."""

    t_s: NotNegative
    x_m: float
    y_m: float
    yaw_rad: float


class AuditEffect(StrictModel):
    """Increase of the vehicle's distance from its path by the object: mean over the judging starts, and its interval [m]."""

    mean_m: float
    low_m: float
    high_m: float
    level: Share = 0.95

    @model_validator(mode="after")
    def _in_order(self) -> AuditEffect:
        if not self.low_m <= self.mean_m <= self.high_m:
            raise ValueError(
                f"expected low_m <= mean_m <= high_m, got {self.low_m}, {self.mean_m}, {self.high_m}"
            )
        return self


class JudgedStart(StrictModel):
    """Two drives from one judging start: with the object, and with the control."""

    x_m: float
    y_m: float
    yaw_rad: float
    off_path_m: NotNegative = Field(
        description="Distance from the path with the object, by the judgement's measure [m]."
    )
    control_off_path_m: NotNegative = Field(description="The same with the control [m].")
    off_track: bool = Field(description="Whether the vehicle left its lane with the object.")
    control_off_track: bool


class DisturbedDrives(StrictModel):
    """Drives from the judging starts with a worse camera: what was found is not always what bears noise and a shaking mount.

    Noise and jitter are drawn for each picture, gain and brightness for each drive; all are standard deviations.
    """

    noise: NotNegative = Field(description="Of each channel of each pixel, in 0..1.")
    gain: NotNegative = Field(description="Of the logarithm of the exposure.")
    brightness: NotNegative = Field(description="Added to all pixels, in 0..1.")
    jitter_m: NotNegative = Field(description="Of the camera's position along each axis [m].")
    jitter_rad: NotNegative = Field(description="Of the camera's rotation about each axis [rad].")
    effect: AuditEffect = Field(description="Over the plain object under the same camera.")
    off_track: Count
    plain_off_track: Count


class AuditedDrives(StrictModel):
    """Drives past an object from the judging starts, which neither search nor selection used."""

    evidence: Evidence = Field(
        description="Where it was driven: in the learned copy of the place, in a world, or by a real vehicle."
    )
    measure: Literal["mean_abs_cte", "max_abs_cte"] = Field(description="What off_path_m is of a drive.")
    control: Control = Field(description="Which control gives the smaller effect.")
    effect: AuditEffect
    disturbed: DisturbedDrives | None = Field(
        default=None, description="The same under a worse camera; null where the camera is the world's own."
    )
    starts: tuple[JudgedStart, ...] = Field(min_length=2)
    path: tuple[RoutePoint, ...] = Field(
        default=(), description="The reference path that the vehicle should follow."
    )
    route: tuple[RoutePoint, ...] = Field(
        default=(), description="What the vehicle drove with the object, from the median start."
    )

    @model_validator(mode="after")
    def _agrees(self) -> AuditedDrives:
        mean_m = sum(each.off_path_m - each.control_off_path_m for each in self.starts) / len(self.starts)
        if abs(mean_m - self.effect.mean_m) > _ROUNDING_M:
            raise ValueError(
                f"expected effect.mean_m to be the mean over the starts, {mean_m:.6f} m, got {self.effect.mean_m}"
            )
        for name, points in (("path", self.path), ("route", self.route)):
            if any(after.t_s <= before.t_s for before, after in pairwise(points)):
                raise ValueError(f"expected increasing t_s in {name}")
        return self

    @property
    def off_track(self) -> int:
        """Number of starts from which the vehicle left its lane with the object."""
        return sum(each.off_track for each in self.starts)


class JudgedObject(StrictModel):
    """The object that was strongest on the selection starts, and its effect from the judging starts."""

    object: AuditedObject
    judgements: tuple[AuditedDrives, ...] = Field(min_length=1, description="One for each kind of evidence.")

    @model_validator(mode="after")
    def _one_each(self) -> JudgedObject:
        kinds = [each.evidence for each in self.judgements]
        if len(set(kinds)) < len(kinds):
            raise ValueError(f"expected one judgement for each kind of evidence, got {', '.join(kinds)}")
        return self


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
    setting: Text | None = Field(
        default=None, description="Setting of the experiment file that runs it again."
    )
    evaluations: Count
    effect_m: float | None = Field(
        description="Mean effect on the selection starts [m]; null if it was not selected from."
    )
    off_track: Count | None = Field(
        default=None,
        description="Selection starts from which the vehicle left its lane; they count before effect_m.",
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
        description="Time that the command took which ended the audit [s], without earlier ones that it went on from; null where the same audit is to give the same bytes."
    )
    ended: Literal["schedule", "budget", "interrupted"]


class AuditComparison(StrictModel):
    """The difference to an earlier audit, over the starts that both judged."""

    file: Text
    sha256: Sha256
    past: Literal["no_object", "plain_object", "object"] | None = Field(
        default=None,
        description="What was driven past where the difference is largest; null in older results.",
    )
    effect: AuditEffect = Field(description="Largest distance from the path now, minus that then.")
    off_track_alone: Count | None = Field(
        default=None, description="Starts from which the vehicle leaves its lane without any object."
    )
    off_track_alone_then: Count | None = Field(default=None, description="The same in the earlier audit.")
    margin_m: NotNegative = Field(description="A lower end above this is worse [m].")
    starts: Annotated[int, Field(ge=2)]

    @property
    def is_worse(self) -> bool:
        """Whether the policy leaves its path by more than before, beyond the margin."""
        return self.effect.low_m > self.margin_m


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
    judged = [each.evidence for each in result.strongest.judgements] if result.strongest else []
    checks = (
        (
            result.place.scale is not None or result.strongest is None,
            "a judged object needs a known scale of the place",
        ),
        (
            outcome not in ("found", "nothing_found") or result.judgement is not None,
            f"{outcome} needs a judgement with the verdict's evidence",
        ),
        (
            result.judgement is None or evidence == max(judged, key=_EVIDENCE.index),
            "a verdict needs the strongest evidence that was judged",
        ),
        (
            (outcome == "worse") == (result.against is not None and result.against.is_worse),
            "worse needs the comparison in against, with a lower end above the margin; such a comparison has no other verdict",
        ),
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
