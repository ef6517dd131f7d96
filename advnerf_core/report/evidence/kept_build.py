"""Whether the scene and the victim of a published set are stored beside it, so that it can be driven again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.errors import AdvnerfError
from advnerf_core.report.evidence.registration import Registration, read_registration

# Folder of the published stages, beside the sets; each has its record. Files of existing policies lie beside the stages, as ``VICTIM``.
BUILD, RECORD, VICTIM = "reference", "stage.json", "victim"
LOST = "cannot be driven again: its scene or victim was not kept"


def is_kept(folder: Path) -> bool:
    """Whether the reference build beside a set has the scene and the victims of every scenario of it."""
    registration = read_registration(folder)
    kept = {digest for file in (folder.parent / BUILD).glob(f"*/{RECORD}") if (digest := _digest_in(file))}
    used = _digests_used(folder, registration) if registration is not None else []
    return bool(used) and all(digest in kept for digest in used)


def stage_problems(published: Path) -> Iterator[str]:
    """Records that cannot be read, and files of a stage that its record says are stored in the folder of another, and are not there."""
    for record in sorted((published / BUILD).glob(f"*/{RECORD}")):
        try:
            stored = sorted(read_json(record).get("files_in", {}).items())
        except (AdvnerfError, AttributeError) as error:
            yield f"{record}: expected the record of a stage, got what cannot be read as one; restore it from git ({error})"
            continue
        for name, folder in stored:
            if not (published / BUILD / folder / name).is_file():
                yield f"{record}: {name} is stored in {folder}, and is not there; restore it from git"


def lost_note(folder: Path) -> list[str]:
    """A sentence for the page if the set cannot be driven again; none if it can."""
    return [] if is_kept(folder) else [f"This set {LOST}.\n"]


def _digest_in(record: Path) -> str | None:
    """Digest of a stage; None if its record is damaged, which `stage_problems` says."""
    try:
        return read_json(record).get("digest")
    except (AdvnerfError, AttributeError):
        return None


def _digests_used(folder: Path, registration: Registration) -> list[str | None]:
    """Digests of scene and victim, of the first cell of every victim in a scenario: `verify` checks that the others are equal."""
    first = {(cell.scenario, cell.victim): cell.name for cell in reversed(registration.cells)}
    files = [file for name in first.values() if (file := folder / f"{name}.json").exists()]
    return [digest for file in files for digest in _digests_of(read_json(file))]


def _digests_of(cell: dict[str, Any]) -> tuple[str | None, str | None]:
    """Digests of scene and victim; an existing victim has no stage, and is there as its files."""
    # A victim with a recipe of its own has a stage of its own, policy-NAME.
    stages = {name.partition("-")[0]: digest for name, digest in cell.get("stages", {}).items()}
    return stages.get("scene"), stages.get("policy") or cell.get("policy_sha256")
