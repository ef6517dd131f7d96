"""An artefact: files stored with the key under which they were made, and with their digest.

A stage, a search, a cell, a verdict and a prediction are artefacts: one with the current key is not made again. A key is a hash over
the settings that differ from their defaults, the code's version, and the digests of its inputs. All settings are stored beside it.

A reference build stores finished stages with the code. With it a machine that has only the repository can continue: it
has the scene, victims and objects that the published cells were run with.
"""

from __future__ import annotations

import filecmp
import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from advnerf_core.documents import read_json
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_json
from advnerf_core.report.evidence import kept_build
from nodes.runtime.paths import shipped

RECORD = kept_build.RECORD
# Folders of cells and stages that are stored with the code.
PUBLISHED = Path("docs/results")
BUILD, VICTIM = kept_build.BUILD, kept_build.VICTIM
_KEY_DIGITS = 16


class ReferenceBuildError(AdvnerfError):
    """A reference build is damaged."""


@dataclass(frozen=True)
class Settings:
    """Settings of an artefact, as JSON data.

    Attributes:
        resolved: All settings and inputs; they are stored beside the key.
        keyed: Content of the key: settings that differ from their defaults, and all inputs. A new setting changes no key, and a changed
            default needs a new version of the code that reads it. Tags of unions have no default, so that they stay.
    """

    resolved: Mapping[str, Any]
    keyed: Mapping[str, Any]

    @property
    def key(self) -> str:
        """The key for these settings."""
        return hash_of(self.keyed)

    @classmethod
    def of(
        cls, model: BaseModel | None = None, include: Any = None, exclude: Any = None, **inputs: Any
    ) -> Settings:
        """Settings of a model, or of the part of it that ``include`` and ``exclude`` choose as for `BaseModel.model_dump`, with inputs.

        Inputs are plain data without defaults, such as digests; without a model there are only these.
        """

        resolved, keyed = (
            {}
            if model is None
            else model.model_dump(mode="json", include=include, exclude=exclude, exclude_defaults=short)
            for short in (False, True)
        )
        # A section in which only other fields differ from their defaults.
        for name in [name for name, each in keyed.items() if each == {} and _has_section(model, name)]:
            del keyed[name]
        # Through JSON, so that tuples and lists cannot change a key between processes.
        return cls(*(json.loads(json.dumps({**each, **inputs})) for each in (resolved, keyed)))

    def noting(self, **facts: Any) -> Settings:
        """The same key, with further facts stored beside it."""
        return replace(self, resolved={**self.resolved, **facts})


def _has_section(model: Any, name: str) -> bool:
    """Whether a field is a section that exists by default."""
    return isinstance(type(model).model_fields[name].get_default(call_default_factory=True), BaseModel)


@dataclass(frozen=True)
class Artefact:
    """The record of a folder of files.

    Attributes:
        key: Hash of everything that the files depend on.
        digest: Digest of the files, once they are finished.
        seconds: Time that making them took [s].
        settings: All settings, including defaults.
        kept: For a stage from a reference build, without intermediate files: digest of the files that it has.
        files_in: For a stage in a reference build: its files that are stored in the folder of another stage beside it, each with that folder's name.
    """

    key: str
    digest: str | None
    seconds: float
    settings: Mapping[str, Any]
    kept: str | None = None
    files_in: Mapping[str, str] = field(default_factory=dict)


def hash_of(value: Any) -> str:
    """SHA-256 of a JSON value, independent of the order of keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def digest_of(folder: Path) -> str:
    """SHA-256 over the names and contents of all files in a folder, except its own record."""
    return _digest_of(_files_in(folder))


def _files_in(folder: Path) -> dict[str, Path]:
    """All files in a folder except its own record, by their names in it."""
    found = (path for path in sorted(folder.rglob("*")) if path.is_file() and path != folder / RECORD)
    return {path.relative_to(folder).as_posix(): path for path in found}


def _digest_of(files: Mapping[str, Path]) -> str:
    digest = hashlib.sha256()
    for name in sorted(files, key=Path):
        digest.update(name.encode() + b"\0")
        with files[name].open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def read_artefact(folder: Path) -> Artefact | None:
    """The record in a folder; None if it is missing or unreadable, as the contents are then unknown."""
    try:
        return Artefact(**read_json(folder / RECORD))
    except (FileNotFoundError, ValueError, TypeError):
        return None


def write_artefact(folder: Path, artefact: Artefact) -> None:
    """Write the record of a folder into it, atomically."""
    known = asdict(replace(artefact, seconds=round(artefact.seconds, 3)))
    write_json(
        folder / RECORD,
        {
            name: each
            for name, each in known.items()
            if name in ("digest", "settings") or each not in (None, {})
        },
    )


def digests_in(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Digests of the finished artefacts of these names in a folder."""
    found = {name: read_artefact(folder / name) for name in names}
    return {name: each.digest for name, each in found.items() if each is not None and each.digest}


def read_current(file: Path, **key: str) -> dict[str, Any] | None:
    """A JSON object whose ``key`` entries are these; None if it is missing, unreadable, or was made under another key."""
    try:
        found = read_json(file)
    except (OSError, ValueError):
        return None
    same = isinstance(found, dict) and all(found.get(name) == value for name, value in key.items())
    return found if same else None


def has_key(file: Path, key: str) -> bool:
    """Whether the files beside a file were made under this key."""
    return read_current(file, key=key) is not None


def write_key(file: Path, key: str, settings: Settings) -> None:
    """Note the key and the settings of the files beside a file."""
    write_json(file, {"key": key, "settings": settings.resolved})


@dataclass(frozen=True)
class ReferenceBuild:
    """A folder of stages stored with the code, one folder each, named by stage and key.

    Intermediate files, such as photographs and training frames, are left out, as only the making of another stage reads them.

    Attributes:
        folder: Folder with one folder per stage; need not exist.
        shipped: Folder to read stages from that are not in ``folder``.
    """

    folder: Path
    shipped: Path | None = None

    def find(self, name: str, key: str) -> Artefact | None:
        """The record of a stage by name and key; None if it is not here."""
        found = read_artefact(self._source(name, key))
        return found if found is not None and found.key == key else None

    def take(self, name: str, key: str, folder: Path) -> Artefact | None:
        """Copy a stage from here into its folder in a run folder, replacing the content; returns its record, None if it is not here.

        Raises:
            ReferenceBuildError: The files differ from the stored ones.
        """
        found = self.find(name, key)
        return None if found is None else self._take(self._source(name, key), found, folder)

    def take_digest(self, name: str, digest: str, key: str, folder: Path) -> Artefact | None:
        """The same for the stage with a digest, regardless of its stored key; its record gets ``key``."""
        for build in filter(None, (self.folder, self.shipped)):
            for file in sorted(build.glob(f"{name}_*/{RECORD}")):
                found = read_artefact(file.parent)
                if found is not None and found.digest == digest:
                    return self._take(file.parent, replace(found, key=key), folder)
        return None

    def _take(self, source: Path, found: Artefact, folder: Path) -> Artefact:
        files = stored_files(source, found)
        if any(not file.exists() for file in files.values()) or _digest_of(files) != found.kept:
            raise ReferenceBuildError(
                f"expected the files in {source} as they were kept, got others; restore them (git checkout -- {source.parent}), or remove the folder to "
                "have the stage made anew"
            )
        taken = replace(found, files_in={})
        _copy(files, folder, taken)
        return taken

    def keep(self, name: str, key: str, folder: Path, bulk: Sequence[str] = ()) -> Path | None:
        """Copy a finished stage from its folder in a run folder to here, without the files that match a pattern of ``bulk``.

        Returns:
            The stage's new folder; None if it was here, or the run folder has no finished stage with this key.
        """
        found, target = read_artefact(folder), self._at(name, key)
        if found is None or found.key != key or found.digest is None or self.find(name, key) is not None:
            return None
        left_out = {path for pattern in bulk for path in folder.glob(pattern)}
        files = _files_in(folder).items()
        _copy(
            {name: file for name, file in files if left_out.isdisjoint([file, *file.parents])}, target, found
        )
        self._share(target)
        return target

    def _share(self, target: Path) -> None:
        """Store the files of a stage once that another folder of the same stage, also of another victim, has too."""
        ours = read_artefact(target)
        assert ours is not None, "it was kept"
        files, shared = _files_in(target), dict[str, str]()
        stage = target.name.rpartition("_")[0].partition("-")[0]
        for record in sorted(self.folder.glob(f"{stage}[_-]*/{RECORD}")):
            other = record.parent
            for name in files.keys() - shared.keys() if other != target else ():
                if (other / name).is_file() and filecmp.cmp(files[name], other / name, shallow=False):
                    shared[name] = other.name
        # The record first: a file that is here twice is no damage.
        write_artefact(target, replace(ours, files_in=dict(sorted(shared.items()))))
        for name in shared:
            files[name].unlink()
        for folder in sorted((path for path in target.rglob("*") if path.is_dir()), reverse=True):
            if not any(folder.iterdir()):
                folder.rmdir()

    def _source(self, name: str, key: str) -> Path:
        at = self._at(name, key)
        return at if self.shipped is None or at.exists() else self.shipped / at.name

    def _at(self, name: str, key: str) -> Path:
        return self.folder / f"{name}_{key[:_KEY_DIGITS]}"


REFERENCE = ReferenceBuild(PUBLISHED / BUILD, shipped(str(PUBLISHED / BUILD)))


def stored_files(folder: Path, record: Artefact) -> dict[str, Path]:
    """All files of a stage in a reference build, by their names in it, wherever they are stored."""
    return {
        **_files_in(folder),
        **{name: folder.with_name(other) / name for name, other in record.files_in.items()},
    }


def _copy(files: Mapping[str, Path], target: Path, artefact: Artefact) -> None:
    """Copy files, all or none, with a record that has their digest."""
    partial = target.with_name(f".{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    for name, file in files.items():
        at = partial / name
        at.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, at)
    write_artefact(partial, replace(artefact, kept=digest_of(partial)))
    shutil.rmtree(target, ignore_errors=True)
    partial.rename(target)
