"""Verifies published results: recomputes every number, and compares every file, cell, drive and start with the registration.

A set is a folder: its registration, one file per cell with its drives, and `SET`, which lists the files with their digests and holds
the published numbers. Beside the folders are the digests of all sets (`DIGESTS`), of everything else (`BESIDE`), and the page. Nothing
here needs torch or a simulator. Each kind of check is a file in `verifying`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from advnerf_core.errors import AdvnerfError
from advnerf_core.report.evidence.about import check_about
from advnerf_core.report.evidence.kept_build import stage_problems
from advnerf_core.report.evidence.publishing import page_text
from advnerf_core.report.evidence.registration import read_withdrawn
from advnerf_core.report.evidence.results import Evidence, read_evidence
from advnerf_core.report.evidence.verifying.checks import set_problems
from advnerf_core.report.evidence.verifying.digests import beside_problems, file_problems, known_digests
from advnerf_core.report.evidence.verifying.layout import PAGE, SET, sets_in
from advnerf_core.report.evidence.verifying.numbers import number_problems, published_numbers
from advnerf_core.report.evidence.verifying.registered import missing_cells
from advnerf_core.report.evidence.verifying.victims import drives_badly, read_declared

# Of files of the right form that make no sense.
_SENSELESS = (ValueError, LookupError, TypeError, AttributeError)


@dataclass(frozen=True)
class Verified:
    """Result of verifying a set.

    Attributes:
        numbers: Number of recomputed published numbers.
        drives: Number of drives behind them.
        findings: Findings against itself that the set declares, as text.
        awaits: Number of cells that a set under way lacks: one that was registered and never published whole.
    """

    name: str
    numbers: int
    drives: int
    problems: tuple[str, ...]
    findings: tuple[str, ...] = ()
    awaits: int = 0


def verify_set(folder: Path) -> Verified:
    """Recompute everything in a set, and compare."""
    try:
        evidence = read_evidence(folder)
        withdrawn, declared = read_withdrawn(folder), read_declared(folder)
    except AdvnerfError as error:
        return Verified(folder.name, 0, 0, (str(error),))
    try:
        missing = len(missing_cells(evidence, withdrawn))
        if missing and not (folder / SET).exists() and folder.name not in known_digests(folder.parent):
            # No number is claimed, but the cells that are there must be right.
            problems = tuple(set_problems(folder, evidence, under_way=True))
            return Verified(folder.name, 0, _drives(evidence), problems, awaits=missing)
        return _verified(folder, evidence, withdrawn, declared)
    except _SENSELESS as error:
        return Verified(
            folder.name, 0, 0, (f"{folder}: cannot be computed again: {error!r}; restore it from git",)
        )


def _drives(evidence: Evidence) -> int:
    return sum(len(kept) for cell in evidence.all_cells for kept in cell.kept.values())


def _verified(
    folder: Path,
    evidence: Evidence,
    withdrawn: Mapping[str, str],
    declared: Mapping[str, str],
) -> Verified:
    problems = [*file_problems(folder), *set_problems(folder, evidence)]
    numbers = 0
    if not problems:  # numbers of damaged drives add nothing
        numbers, problems = number_problems(folder, published_numbers(evidence, withdrawn, declared))
    return Verified(
        folder.name, numbers, _drives(evidence), tuple(problems), tuple(_findings(evidence, problems))
    )


def verify_beside(published: Path) -> tuple[str, ...]:
    """Problems of the page of all sets, the pictures and films, the reference build and the sets without a registration."""
    problems = [*beside_problems(published), *stage_problems(published)]
    page = published / PAGE
    try:
        check_about(published, sets_in(published))
    except AdvnerfError as error:
        return (*problems, str(error))
    try:
        if not page.exists() or page.read_text(encoding="utf-8") != page_text(published):
            problems.append(f"{page}: is not the page of the published sets")
    except (OSError, StopIteration, *_SENSELESS) as error:  # of damaged manifests
        problems.append(f"{page}: cannot be made from the published sets: {error!r}")
    return tuple(problems)


def _findings(evidence: Evidence, problems: Sequence[str]) -> Iterator[str]:
    if problems:
        return
    for row in drives_badly(evidence):
        yield (
            f"{row['scenario']} {row['victim']} does not drive well {row['domain']}: mean |CTE| {row['mean_cte_m']:.4f} m without "
            f"attack, at most {row['limit_m']:.4f} m was registered; {row['off_track']} drives off the track"
        )
