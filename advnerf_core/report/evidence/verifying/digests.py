"""Whether every published file is unchanged: manifests with the digest of each file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.files import sha256_of, write_json
from advnerf_core.report.evidence.registration import SetError
from advnerf_core.report.evidence.verifying.layout import BESIDE, DIGESTS, SET, sets_in

# Its pages are recomputed from the listed files, and the log of removals only ever grows.
_NOT_LISTED = (BESIDE, DIGESTS, "removed.json")


def digests_of(folder: Path) -> dict[str, str]:
    """SHA-256 of every file in the folder of a set except its manifest, by path."""
    return _digests(folder, lambda name: name != SET)


def digests_beside(published: Path) -> dict[str, str]:
    """SHA-256 of every published file that belongs to no registered set and is no page, by path."""
    sets = set(sets_in(published))

    def listed(name: str) -> bool:
        return name.split("/")[0] not in sets and name not in _NOT_LISTED and not name.endswith(".md")

    return _digests(published, listed)


def known_digests(published: Path) -> dict[str, str]:
    """Digest of each set's manifest, by name of the set."""
    file = published / DIGESTS
    return _listed(read_json(file), file) if file.exists() else {}


def write_known_digest(folder: Path) -> None:
    """Write the digest of a set's manifest beside the folders of all sets."""
    known = known_digests(folder.parent)
    known[folder.name] = sha256_of(folder / SET)
    write_json(folder.parent / DIGESTS, dict(sorted(known.items())))


def write_beside(published: Path) -> None:
    """Write the manifest of every file that belongs to no registered set."""
    write_json(published / BESIDE, dict(sorted(digests_beside(published).items())))


def file_problems(folder: Path) -> Iterator[str]:
    """Whether a set's files match its manifest, and the manifest is the published one."""
    file = folder / SET
    try:
        listed = _listed(read_json(file)["files"], file)
        known = known_digests(folder.parent).get(folder.name)
    except (OSError, ValueError, KeyError, TypeError) as error:
        yield f"{file}: cannot be read: {error}"
        return
    if known != sha256_of(file):
        yield f"{file}: its digest is not the one in {folder.parent / DIGESTS}"
    yield from _compared(folder, SET, listed, digests_of(folder))


def beside_problems(published: Path) -> Iterator[str]:
    """Whether pictures, films, the reference build and sets without a registration match their manifest."""
    try:
        listed = _listed(read_json(published / BESIDE), published / BESIDE)
        missing = sorted(known_digests(published).keys() - sets_in(published))
    except (OSError, ValueError) as error:
        yield f"{published / BESIDE}: cannot be read: {error}; advnerf experiment publish writes it"
        return
    yield from (f"{published / name}: is listed in {DIGESTS}, and has no registration" for name in missing)
    for problem in _compared(published, BESIDE, listed, digests_beside(published)):
        yield f"{problem}; restore it from git, or, if the change is meant: python -m benchmarks.set_pages --page"


def _listed(found: Any, file: Path) -> dict[str, str]:
    """Digests by name, of a file that was read; a `SetError` names it if it holds something else."""
    if not isinstance(found, dict) or not all(isinstance(digest, str) for digest in found.values()):
        raise SetError(f"{file}: expected a digest for each name, got {found!r:.60}; restore it from git")
    return found


def _compared(
    folder: Path, manifest: str, listed: Mapping[str, str], found: Mapping[str, str]
) -> Iterator[str]:
    for name in sorted(listed.keys() | found.keys()):
        if name not in found:
            yield f"{folder / name}: is listed in {manifest}, and is not there"
        elif name not in listed:
            yield f"{folder / name}: is not listed in {manifest}"
        elif listed[name] != found[name]:
            yield f"{folder / name}: its digest is not the one in {manifest}"


def _digests(folder: Path, listed: Callable[[str], bool]) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    names = ((file.relative_to(folder).as_posix(), file) for file in files)
    return {name: sha256_of(file) for name, file in names if listed(name)}
