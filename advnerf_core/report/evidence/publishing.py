"""Writing a published set: its manifest with all numbers, its picture, and the page and the manifest of all sets."""

from __future__ import annotations

from pathlib import Path

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically, write_json
from advnerf_core.report.evidence.about import read_about
from advnerf_core.report.evidence.families import families_note
from advnerf_core.report.evidence.hardness import with_titles
from advnerf_core.report.evidence.kept_build import lost_note
from advnerf_core.report.evidence.page import film_of, results_page
from advnerf_core.report.evidence.registration import SetError, read_registration, read_withdrawn
from advnerf_core.report.evidence.results import read_evidence
from advnerf_core.report.evidence.verifying.checks import set_problems
from advnerf_core.report.evidence.verifying.digests import digests_of, write_beside, write_known_digest
from advnerf_core.report.evidence.verifying.layout import PAGE, SET, complete_sets
from advnerf_core.report.evidence.verifying.numbers import published_numbers
from advnerf_core.report.evidence.verifying.pictures import write_picture
from advnerf_core.report.evidence.verifying.victims import read_declared


def write_numbers(folder: Path) -> Path:
    """Write the manifest, the numbers and the pictures of a set, and beside its folder its digest.

    Raises:
        SetError: The folder has no registration, its cells contradict it, or a victim does not drive well and that is not
            declared.
    """
    evidence, withdrawn, declared = read_evidence(folder), read_withdrawn(folder), read_declared(folder)
    problems = list(set_problems(folder, evidence))
    if problems:
        raise SetError(f"{folder}: cannot be published: {problems[0]} ({len(problems)} problems in all)")
    numbers = published_numbers(evidence, withdrawn, declared)
    named = {key: numbers.pop(key) for key in ("format", "name", "registration")}
    data = {**named, "files": digests_of(folder), **numbers}
    write_json(folder / SET, data)
    write_known_digest(folder)
    write_picture(evidence, folder, folder.parent)
    from advnerf_core.report.evidence.above import write_above_of  # loads matplotlib

    write_above_of(folder)
    return folder / SET


def write_page(published: Path) -> Path:
    """Write the page of all sets, and the manifest of the files beside them; call it last, after pictures and films."""
    write_atomically(published / PAGE, page_text(published))
    write_beside(published)
    return published / PAGE


def page_text(published: Path) -> str:
    """The page of all sets, from their manifests and registrations."""
    sets, about = {}, read_about(published)
    for name in complete_sets(published):
        registration = read_registration(published / name)
        if registration is not None:
            registered = {**registration.model_dump(mode="json"), "digest": registration.digest}
            data = with_titles(published / name, read_json(published / name / SET))
            filmed = (published / film_of(name)).exists()
            notes = [*families_note(registration), *lost_note(published / name)]
            said = about[name].model_dump(mode="json") if name in about else None
            sets[name] = {**data, "registered": registered, "about": said, "filmed": filmed, "notes": notes}
    return results_page(sets)
