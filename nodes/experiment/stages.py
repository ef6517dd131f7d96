"""Stages of a long job: run once, cached by their inputs, resumed where they were stopped.

A run folder holds one sub-folder per stage. A stage is finished when its ``stage.json`` says so *and* the key in it equals the
key of what would be run now. The key is a hash over the stage's configuration, its code version and the digests of what the
stages before it wrote, so a changed setting runs exactly what depends on it. An interrupted stage keeps its folder: with an
unchanged key it finds its own partial work there, otherwise the folder is emptied first. What a stage *does* is not known here.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_atomically
from nodes.runtime.locks import HeldError, hold
from nodes.runtime.progress import Display, Report

_RECORD = "stage.json"


class StageError(AdvnerfError):
    """A stage was asked for that does not exist, or whose inputs are not there."""


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
    """

    name: str
    run: Callable[[Path, Report], None]
    settings: Mapping[str, Any]
    after: Sequence[str] = ()
    version: int = 1
    goes_on_from: Sequence[Mapping[str, Any]] = ()


@dataclass(frozen=True)
class StageRecord:
    """What is remembered of a stage: its key, once finished the digest of its files and the seconds it took, and its settings.

    The settings are part of the key already; apart from it they say what a folder was made with. None in records from before they were kept.
    """

    key: str
    digest: str | None
    seconds: float
    settings: Mapping[str, Any] | None = None


def run_stages(
    stages: Sequence[Stage], folder: Path, display: Display, until: str | None = None
) -> dict[str, StageRecord]:
    """Run the stages in order, skipping those whose result is there and still fits.

    Args:
        stages: The stages, each after those it names in ``after``.
        folder: The run folder.
        display: Told of starts, progress and ends.
        until: Name of the last stage wanted; None runs all.

    Returns:
        The record of every stage that was considered, by name.

    Raises:
        StageError: ``until`` or an ``after`` names no stage before it.
    """
    check_until(stages, until)
    records: dict[str, StageRecord] = {}
    for stage in stages:
        records[stage.name] = _run_or_reuse(stage, folder / stage.name, records, display)
        if stage.name == until:
            break
    return records


def check_until(stages: Sequence[Stage], until: str | None) -> None:
    """Refuse a last stage that does not exist, before anything is written."""
    if until is not None and until not in [stage.name for stage in stages]:
        raise StageError(f"expected one of the stages {', '.join(s.name for s in stages)}; got '{until}'")


def read_record(folder: Path) -> StageRecord | None:
    """The record in a stage's folder; None if there is none that can be read."""
    try:
        fields = json.loads((folder / _RECORD).read_text())
        return StageRecord(
            str(fields["key"]), fields["digest"], float(fields["seconds"]), fields.get("settings")
        )
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        # An unreadable record means unknown contents: the stage is run again from nothing.
        return None


def is_current(stages: Sequence[Stage], folder: Path, name: str) -> bool:
    """Whether a stage and all that it builds on are finished, and are what would be run now."""
    return name in _current(stages, folder)


def _current(stages: Sequence[Stage], folder: Path) -> dict[str, StageRecord]:
    records: dict[str, StageRecord] = {}
    for stage in stages:
        record = read_record(folder / stage.name)
        if record is None or record.digest is None or any(earlier not in records for earlier in stage.after):
            continue
        if record.key == _key_of(stage, records):
            records[stage.name] = record
    return records


def fits_what_is_there(stage: Stage, folder: Path) -> bool:
    """Whether a stage's finished result, whatever its settings, was made from what the stages before it hold now."""
    record = read_record(folder / stage.name)
    before = {name: read_record(folder / name) for name in stage.after}
    known = {name: each for name, each in before.items() if each is not None}
    if record is None or record.digest is None or record.settings is None or len(known) != len(before):
        return False
    return record.key == _key_of(replace(stage, settings=record.settings), known)


def begun_with(stages: Sequence[Stage], folder: Path, name: str) -> Mapping[str, Any] | None:
    """The settings that a stage's folder was begun with, if running the stage now would go on from there; None if it would not."""
    records = _current(stages, folder)
    stage = next(each for each in stages if each.name == name)
    record = read_record(folder / name)
    if record is None or any(earlier not in records for earlier in stage.after):
        return None
    known = (stage.settings, *stage.goes_on_from)
    return next(
        (each for each in known if record.key == _key_of(replace(stage, settings=each), records)), None
    )


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
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p != folder / _RECORD):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0")
        with path.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _run_or_reuse(
    stage: Stage, folder: Path, records: Mapping[str, StageRecord], display: Display
) -> StageRecord:
    missing = [name for name in stage.after if name not in records]
    if missing:
        raise StageError(f"stage '{stage.name}' needs {', '.join(missing)} to run before it")
    key = _key_of(stage, records)
    if (old := _finished(folder, key, display)) is not None:
        return old
    with _alone(folder):
        # Whoever held it may have made just this.
        if (old := _finished(folder, key, display)) is not None:
            return old
        return _go_on_or_begin(stage, folder, key, records, display)


def _finished(folder: Path, key: str, display: Display) -> StageRecord | None:
    record = read_record(folder)
    if record is None or record.key != key or record.digest is None:
        return None
    display.finish(folder.name, record.seconds, cached=True)
    return record


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Two processes in one stage's folder would write each other's files."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        lock = hold(folder.parent / f".{folder.name}.lock")
    except HeldError as held:
        raise StageError(
            f"expected {folder} for this process alone, but process {held.owner} is at work there; wait for it, or name another run folder"
        ) from None
    with lock:
        yield


def _go_on_or_begin(
    stage: Stage, folder: Path, key: str, records: Mapping[str, StageRecord], display: Display
) -> StageRecord:
    old = read_record(folder)
    parts = [_key_of(replace(stage, settings=settings), records) for settings in stage.goes_on_from]
    resumed = old is not None and old.key in (key, *parts)
    if not resumed and folder.exists():
        if not (folder / _RECORD).exists() and any(folder.iterdir()):
            raise StageError(
                f"expected {folder} to be a stage's folder, got files that no stage wrote; move them, or name another run folder"
            )
        shutil.rmtree(folder)
    earlier_s = old.seconds if resumed and old is not None else 0.0
    return _run(stage, folder, key, earlier_s, display)


def _key_of(stage: Stage, records: Mapping[str, StageRecord]) -> str:
    inputs = {name: records[name].digest for name in stage.after}
    return hash_of(
        {"name": stage.name, "version": stage.version, "settings": stage.settings, "inputs": inputs}
    )


def _run(stage: Stage, folder: Path, key: str, earlier_s: float, display: Display) -> StageRecord:
    folder.mkdir(parents=True, exist_ok=True)
    settings = json.loads(json.dumps(stage.settings))
    _write_record(folder, StageRecord(key, None, earlier_s, settings))
    report = display.start(stage.name)
    begin = time.monotonic()
    try:
        stage.run(folder, report)
    except BaseException:
        _write_record(folder, StageRecord(key, None, earlier_s + time.monotonic() - begin, settings))
        raise
    record = StageRecord(key, digest_of(folder), earlier_s + time.monotonic() - begin, settings)
    _write_record(folder, record)
    display.finish(stage.name, record.seconds, cached=False)
    return record


def _write_record(folder: Path, record: StageRecord) -> None:
    known = {
        "key": record.key,
        "digest": record.digest,
        "seconds": round(record.seconds, 3),
        "settings": record.settings,
    }
    write_atomically(folder / _RECORD, json.dumps(known, indent=1) + "\n")
