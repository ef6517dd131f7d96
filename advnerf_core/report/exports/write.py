"""Writes an audit's result in all formats."""

from __future__ import annotations

from pathlib import Path

from advnerf_core.report.audit_result import AuditResult
from advnerf_core.report.exports.junit import write_junit
from advnerf_core.report.exports.openscenario import write_openscenario
from advnerf_core.report.exports.sarif import write_sarif

SARIF_FILE, JUNIT_FILE, SCENARIO_FILE = "audit.sarif", "audit.junit.xml", "audit.xosc"


def write_exports(folder: Path, result: AuditResult) -> tuple[Path, ...]:
    """Write SARIF, JUnit and, if an object was judged, OpenSCENARIO into the audit's folder (extra ``audit``); returns the files.

    Without a judged object, the scenario of an earlier run there is removed.
    """
    files = [folder / SARIF_FILE, folder / JUNIT_FILE]
    write_sarif(files[0], result)
    write_junit(files[1], result)
    if result.strongest is not None and result.vehicle is not None:
        files.append(folder / SCENARIO_FILE)
        write_openscenario(files[2], result)
    else:
        (folder / SCENARIO_FILE).unlink(missing_ok=True)
    return tuple(files)
