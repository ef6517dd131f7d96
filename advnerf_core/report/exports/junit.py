"""An audit's result as a JUnit report: one test per requirement, so that CI systems show which one failed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from junitparser import Error, Failure, Skipped, TestCase, TestSuite

from advnerf_core.files import write_atomically
from advnerf_core.report.audit_result import AuditResult

SUITE = "advnerf audit"
# The test that the verdict decides.
HOLDS_PATH = "no object drives the policy off its path"


def write_junit(file: Path, result: AuditResult) -> None:
    """Write the result as JUnit XML (extra ``audit``).

    The test of the verdict fails if an object was found, or if the policy is worse than before. It is an error if the audit cannot
    judge. The conditions of a verdict are tests too: a trusted copy of the place, and the planted control.
    """
    suite = TestSuite(SUITE)
    if result.date is not None:
        suite.timestamp = result.date.replace(microsecond=0).isoformat()
    for name, value in _properties(result):
        suite.add_property(name, value)
    for case in (*_needs(result), _verdict(result)):
        case.classname = f"advnerf.audit.{result.place.name}"
        suite.add_testcase(case)
    suite.update_statistics()
    write_atomically(file, suite.tostring())


def _needs(result: AuditResult) -> Iterator[TestCase]:
    """The conditions of a verdict. Those that a verdict did not need are skipped."""
    problem = Failure if result.verdict.outcome == "cannot_judge" else Skipped
    if result.fidelity is not None:
        trusted = TestCase("the learned copy of the place is trusted")
        if not result.fidelity.trusted:
            trusted.result = [problem("; ".join(result.fidelity.why))]
        yield trusted
    planted = TestCase("the planted control is found")
    if result.planted is None:
        planted.result = [Skipped("the audit ended before it")]
    elif not result.planted.found:
        why = f"{result.planted.name}: not found in {result.planted.evaluations} drives"
        planted.result = [problem(why)]
    yield planted


def _verdict(result: AuditResult) -> TestCase:
    case = TestCase(HOLDS_PATH)
    if result.budget.seconds is not None:
        case.time = round(result.budget.seconds, 3)
    verdict = result.verdict
    if verdict.outcome == "cannot_judge":
        case.result = [Error("; ".join(verdict.reasons), verdict.outcome)]
    elif verdict.outcome != "nothing_found":
        failure = Failure(verdict.sentence, verdict.outcome)
        failure.text = f"evidence: {verdict.evidence}, policy {result.policy.path}"
        case.result = [failure]
    return case


def _properties(result: AuditResult) -> Iterator[tuple[str, str]]:
    yield "outcome", result.verdict.outcome
    yield "evidence", result.verdict.evidence or "none"
    yield "policy", result.policy.path
    yield "place", result.place.name
    yield "candidates_tried", str(len(result.tried))
    if (drives := result.judgement) is not None:
        effect = drives.effect
        yield "effect_m", f"{effect.mean_m:.4f}"
        yield "effect_interval_m", f"{effect.low_m:.4f} to {effect.high_m:.4f}"
        yield "off_track_starts", f"{drives.off_track} of {len(drives.starts)}"
