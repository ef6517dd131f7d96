"""An audit's verdict as SARIF 2.1.0, which code scanning of GitHub, GitLab and Azure DevOps reads.

One run has one result for the policy file. A found object is a failure: an error if it was driven in a world or by a real vehicle, a
warning if it was driven in a learned copy only. Nothing found is a result of kind ``pass``, and an audit that cannot judge one of kind
``open``; scanners do not list these.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sarif_pydantic import (
    Artifact,
    ArtifactLocation,
    Invocation,
    Level,
    Location,
    LogicalLocation,
    Message,
    PhysicalLocation,
    ReportingDescriptor,
    Result,
    Run,
    Sarif,
    Tool,
    ToolDriver,
)

from advnerf_core.files import write_atomically
from advnerf_core.report.audit_result import AuditResult

SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"
OFF_PATH, WORSE = "ADV1001", "ADV1002"
# Name, message and advice of each rule.
_RULES = {
    OFF_PATH: (
        "ObjectDrivesPolicyOffPath",
        "An object beside the path drives the policy off it.",
        "Look at the audit's page for the object and the drives. Train the policy with frames past such objects, then audit it again.",
    ),
    WORSE: (
        "PolicyWorseThanBefore",
        "Objects drive the policy further off its path than an earlier version.",
        "Compare both audits' pages. They drove from the same starts, so the difference is the policy's.",
    ),
}
_KINDS = {"nothing_found": "pass", "found": "fail", "cannot_judge": "open", "worse": "fail"}


def write_sarif(file: Path, result: AuditResult) -> None:
    """Write the verdict as SARIF 2.1.0 (extra ``audit``)."""
    rules = [
        ReportingDescriptor(
            id=rule,
            name=name,
            short_description={"text": says},
            full_description={"text": says},
            help={"text": advice},
        )
        for rule, (name, says, advice) in _RULES.items()
    ]
    driver = ToolDriver(name="advnerf", version=result.versions.get("advnerf"), rules=rules)
    run = Run(
        tool=Tool(driver=driver),
        invocations=[Invocation(execution_successful=True, end_time_utc=result.date)],
        artifacts=_artifacts(result),
        results=[_result(result)],
    )
    log = Sarif(schema_uri=SCHEMA, runs=[run])
    write_atomically(file, log.model_dump_json(by_alias=True, exclude_none=True, indent=1) + "\n")


def _result(result: AuditResult) -> Result:
    rule = WORSE if result.verdict.outcome == "worse" else OFF_PATH
    level = Level.NONE
    if _KINDS[result.verdict.outcome] == "fail":
        level = Level.WARNING if result.verdict.evidence == "surrogate" else Level.ERROR
    text = " ".join((result.verdict.sentence, *result.verdict.reasons))
    # The same finding in the next audit of the same policy in the same place, even with other numbers.
    same = hashlib.sha256(f"{rule}\n{result.policy.path}\n{result.place.name}".encode()).hexdigest()
    return Result(
        rule_id=rule,
        rule_index=list(_RULES).index(rule),
        kind=_KINDS[result.verdict.outcome],
        level=level,
        message=Message(text=text),
        locations=[_location(result)],
        partial_fingerprints={"policyAndPlace/v1": same},
        properties=_properties(result),
    )


def _location(result: AuditResult) -> Location:
    """The policy file; its name for a policy without a file."""
    path = result.policy.path
    if result.policy.sha256 is None:
        return Location(logical_locations=[LogicalLocation(fully_qualified_name=path, kind="module")])
    return Location(
        physical_location=PhysicalLocation(artifact_location=ArtifactLocation(uri=_uri(path), index=0))
    )


def _artifacts(result: AuditResult) -> list[Any] | None:
    if result.policy.sha256 is None:
        return None
    where = ArtifactLocation(uri=_uri(result.policy.path))
    return [Artifact(location=where, hashes={"sha-256": result.policy.sha256})]


def _uri(path: str) -> str:
    """A file as a URI; a relative one stays relative, to the root of the repository."""
    return Path(path).as_uri() if Path(path).is_absolute() else quote(Path(path).as_posix())


def _properties(result: AuditResult) -> dict[str, Any]:
    """Numbers for tools that show the property bag."""
    drives, found = result.judgement, result.strongest
    known: dict[str, Any] = {
        "outcome": result.verdict.outcome,
        "evidence": result.verdict.evidence,
        "place": result.place.name,
        "candidatesTried": len(result.tried),
    }
    if drives is not None and found is not None:
        known |= {
            "object": found.object.name,
            "effectM": drives.effect.mean_m,
            "effectLowM": drives.effect.low_m,
            "effectHighM": drives.effect.high_m,
            "offTrackStarts": drives.off_track,
            "starts": len(drives.starts),
        }
    return known
