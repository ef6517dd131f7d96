"""What is known of a stage before it runs, and what is remembered of it afterwards: its key, and the digest of what it wrote."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from advnerf_core.report.evidence import kept_build
from nodes.runtime.progress import MeasuringReport

RECORD = kept_build.RECORD


@dataclass(frozen=True)
class Stage:
    """One step of a job.

    Attributes:
        name: Name of the stage and of its folder.
        run: Does the work, writing only below the given folder.
        settings: The part of the configuration that the result depends on (JSON types).
        after: Stages whose outputs this one reads.
        version: Raised when the meaning of the stage's output changes.
        goes_on_from: Other settings whose result is a part of this one, as fewer rounds are: their folder is gone on from, not wiped.
        bulk: Patterns of files that only the making of other stages reads, or of this one: a reference build leaves them out.
        reads_bulk_of: Stages whose bulk this one reads.
    """

    name: str
    run: Callable[[Path, MeasuringReport], None]
    settings: Mapping[str, Any]
    after: Sequence[str] = ()
    version: int = 1
    goes_on_from: Sequence[Mapping[str, Any]] = ()
    bulk: Sequence[str] = ()
    reads_bulk_of: Sequence[str] = ()


@dataclass(frozen=True)
class StageRecord:
    """What is remembered of a stage.

    Attributes:
        key: Hash of all that it depends on.
        digest: Of its files, once it is finished.
        seconds: How long it took.
        settings: A part of the key already; apart from it they say what a folder was made with.
        kept: Of a stage from a reference build, which has no bulk: digest of the files that it does have.
        files_in: Of a stage in a reference build: folder beside it that has the same files, which are kept once; empty where its own folder has them.
    """

    key: str
    digest: str | None
    seconds: float
    settings: Mapping[str, Any]
    kept: str | None = None
    files_in: str = ""


def read_record(folder: Path) -> StageRecord | None:
    """The record in a stage's folder; None if there is none that can be read."""
    try:
        fields = read_json(folder / RECORD)
        return StageRecord(
            str(fields["key"]),
            fields["digest"],
            float(fields["seconds"]),
            fields["settings"],
            fields.get("kept"),
            fields.get("files_in", ""),
        )
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        # An unreadable record means unknown contents: the stage is run again from nothing.
        return None


def stage_digests(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Digests of what finished stages of a run folder wrote, of those of some names that there are."""
    records = {name: read_record(folder / name) for name in names}
    return {name: record.digest for name, record in records.items() if record is not None and record.digest}


def hash_of(value: Any) -> str:
    """SHA-256 of a JSON value, independent of the order of keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def digest_of(folder: Path) -> str:
    """SHA-256 over the names and contents of all files below a folder, the stage's own record excepted."""
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p != folder / RECORD):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0")
        with path.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def key_of(stage: Stage, records: Mapping[str, StageRecord]) -> str:
    """Hash over a stage's settings and version, and the digests of what the stages before it wrote."""
    inputs = {name: records[name].digest for name in stage.after}
    return hash_of(
        {"name": stage.name, "version": stage.version, "settings": stage.settings, "inputs": inputs}
    )


def write_record(folder: Path, record: StageRecord) -> None:
    """Write a stage's record into its folder, atomically."""
    known = {
        "key": record.key,
        "digest": record.digest,
        "seconds": round(record.seconds, 3),
        "settings": record.settings,
        **({} if record.kept is None else {"kept": record.kept}),
        **({"files_in": record.files_in} if record.files_in else {}),
    }
    write_atomically(folder / RECORD, json.dumps(known, indent=1) + "\n")
