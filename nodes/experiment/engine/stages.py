"""Stages of a long job: run once, cached by their inputs, resumed after an interruption.

A run folder holds one sub-folder per stage. A stage is finished when its ``stage.json`` says so *and* the key in it equals the
current key. The key is a hash over the stage's configuration, its code version and the digests of the outputs of
the stages before it, so a changed setting reruns exactly the stages that depend on it. An interrupted stage keeps its folder: with an
unchanged key it finds its own partial work there, otherwise the folder is emptied first. A stage whose key a reference build has is
copied from there. The content of a stage is unknown here.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TextIO

from advnerf_core.errors import AdvnerfError
from nodes.experiment.engine.artefact import (
    RECORD,
    Artefact,
    ReferenceBuild,
    Settings,
    digest_of,
    hash_of,
    read_artefact,
    write_artefact,
)
from nodes.runtime.locks import HeldError, hold
from nodes.runtime.progress import MeasuringReport, StageDisplay


class StageError(AdvnerfError):
    """A requested stage does not exist, or its inputs are missing."""


@dataclass(frozen=True)
class Stage:
    """One step of a job.

    Attributes:
        name: Name of the stage and of its folder.
        run: Does the work, writing only to the given folder.
        settings: The part of the configuration that the result depends on, and further inputs that do not come from stages.
        after: Stages whose outputs this one reads.
        version: Raised when the meaning of the stage's output changes.
        resumes_from: Other settings whose result is a part of this one, such as fewer rounds: their folder is resumed, not wiped.
        bulk: Patterns of intermediate files, which only the making of other stages, or of this one, reads: a reference build leaves them out.
        reads_bulk_of: Stages whose intermediate files this one reads.
    """

    name: str
    run: Callable[[Path, MeasuringReport], None]
    settings: Settings
    after: Sequence[str] = ()
    version: int = 1
    resumes_from: Sequence[Settings] = ()
    bulk: Sequence[str] = ()
    reads_bulk_of: Sequence[str] = ()


def key_of(stage: Stage, records: Mapping[str, Artefact]) -> str:
    """Hash over a stage's settings and version, and the digests of the earlier stages' outputs."""
    inputs = {name: records[name].digest for name in stage.after}
    return hash_of(
        {"name": stage.name, "version": stage.version, "settings": stage.settings.keyed, "inputs": inputs}
    )


def stage_digests(stages: Sequence[Stage], folder: Path, reference: ReferenceBuild) -> dict[str, str]:
    """Digests of the stages' outputs that a run folder has, or else a reference build."""
    records: dict[str, Artefact] = {}
    for stage in stages:
        if any(name not in records for name in stage.after):
            continue
        found = read_artefact(folder / stage.name) or reference.find(stage.name, key_of(stage, records))
        if found is not None and found.digest is not None:
            records[stage.name] = found
    return {name: str(record.digest) for name, record in records.items()}


def run_stages(
    stages: Sequence[Stage],
    folder: Path,
    display: StageDisplay,
    until: str | None = None,
    reference: ReferenceBuild | None = None,
) -> dict[str, Artefact]:
    """Run the stages in order, skipping those with a current result here or in a reference build.

    Args:
        stages: The stages, each after those it names in ``after``.
        until: Name of the last stage to run; None runs all.

    Returns:
        The record of every stage up to ``until``, by name.

    Raises:
        StageError: ``until`` or an ``after`` names no stage before it.
    """
    check_until(stages, until)
    wanted = stages if until is None else stages[: [stage.name for stage in stages].index(until) + 1]
    whole = _read_whole(wanted, folder, reference)
    records: dict[str, Artefact] = {}
    for stage in wanted:
        at = _Place(folder / stage.name, reference, stage.name in whole)
        records[stage.name] = _run_or_reuse(stage, at, records, display)
    return records


def _read_whole(stages: Sequence[Stage], folder: Path, reference: ReferenceBuild | None) -> set[str]:
    """Stages whose intermediate files will be read, because a stage that reads them has to run."""
    there, whole = _current(stages, folder, reference), set()
    # From the last to the first: a stage that runs to restore its intermediate files reads the files of earlier ones.
    for stage in reversed(stages):
        if stage.name not in there or (stage.name in whole and there[stage.name].kept is not None):
            whole |= set(stage.reads_bulk_of)
    return whole


def check_until(stages: Sequence[Stage], until: str | None) -> None:
    """Raise for a last stage that does not exist, before anything is written."""
    if until is not None and until not in [stage.name for stage in stages]:
        raise StageError(f"expected one of the stages {', '.join(s.name for s in stages)}; got '{until}'")


def _current(
    stages: Sequence[Stage], folder: Path, reference: ReferenceBuild | None = None
) -> dict[str, Artefact]:
    """Stages that are finished and current, as are all stages that they build on."""
    records: dict[str, Artefact] = {}
    for stage in stages:
        if any(earlier not in records for earlier in stage.after):
            continue
        record, key = read_artefact(folder / stage.name), key_of(stage, records)
        if record is None or record.digest is None or record.key != key:
            record = None if reference is None else reference.find(stage.name, key)
        if record is not None:
            records[stage.name] = record
    return records


def outdated(stages: Sequence[Stage], folder: Path, reference: ReferenceBuild | None = None) -> list[str]:
    """Names of the finished stages in a run folder that a run would make or take anew: their settings or inputs have changed since."""
    records = _current(stages, folder, reference)
    found = []
    for stage in stages:
        record = read_artefact(folder / stage.name)
        if record is None or record.digest is None:
            continue
        known = (stage.settings, *stage.resumes_from) if all(name in records for name in stage.after) else ()
        if record.key not in [key_of(replace(stage, settings=each), records) for each in known]:
            found.append(stage.name)
    return found


def begun_with(stages: Sequence[Stage], folder: Path, name: str) -> Settings | None:
    """The settings of a stage's begun folder, if running the stage now would resume it; else None."""
    records = _current(stages, folder)
    stage = next(each for each in stages if each.name == name)
    record = read_artefact(folder / name)
    if record is None or any(earlier not in records for earlier in stage.after):
        return None
    known = (stage.settings, *stage.resumes_from)
    return next(
        (each for each in known if record.key == key_of(replace(stage, settings=each), records)), None
    )


def keep_stages(stages: Sequence[Stage], folder: Path, reference: ReferenceBuild) -> list[Path]:
    """Copy finished and current stages from a run folder into a reference build; returns the new folders there."""
    records = _current(stages, folder)
    found = [
        reference.keep(stage.name, records[stage.name].key, folder / stage.name, stage.bulk)
        for stage in stages
        if stage.name in records
    ]
    return [each for each in found if each is not None]


@dataclass(frozen=True)
class _Place:
    """Folder of a stage, a further place of its result, and whether its intermediate files are needed too."""

    folder: Path
    reference: ReferenceBuild | None
    whole: bool


def _run_or_reuse(
    stage: Stage, at: _Place, records: Mapping[str, Artefact], display: StageDisplay
) -> Artefact:
    missing = [name for name in stage.after if name not in records]
    if missing:
        raise StageError(f"stage '{stage.name}' needs {', '.join(missing)} to run before it")
    key = key_of(stage, records)
    if (old := _finished(at, key, display)) is not None:
        return old
    with _lock(at.folder):
        # The process that held the lock may have made exactly this.
        if (old := _finished(at, key, display)) is not None:
            return old
        return _go_on_or_begin(stage, at, key, records, display)


def _finished(at: _Place, key: str, display: StageDisplay) -> Artefact | None:
    record = read_artefact(at.folder)
    if record is None or record.key != key or record.digest is None:
        return None
    if at.whole and record.kept is not None:
        return None
    display.finish(at.folder.name, record.seconds, cached=True)
    return record


def _lock(folder: Path) -> TextIO:
    """The lock of a stage's folder, as two processes in it would write each other's files."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        return hold(folder.parent / f".{folder.name}.lock")
    except HeldError as held:
        raise StageError(
            f"expected {folder} for this process alone, but process {held.owner} is at work there; wait for it, or name another run folder"
        ) from None


def _go_on_or_begin(
    stage: Stage, at: _Place, key: str, records: Mapping[str, Artefact], display: StageDisplay
) -> Artefact:
    folder, old = at.folder, read_artefact(at.folder)
    parts = [key_of(replace(stage, settings=settings), records) for settings in stage.resumes_from]
    resumed = old is not None and old.kept is None and old.key in (key, *parts)
    if at.reference is not None and not at.whole and at.reference.find(stage.name, key) is not None:
        _require_ours(folder)
        if (taken := at.reference.take(stage.name, key, folder)) is not None:
            display.finish(stage.name, taken.seconds, cached=True)
            return taken
    if not resumed and folder.exists():
        _require_ours(folder)
        shutil.rmtree(folder)
    earlier_s = old.seconds if resumed and old is not None else 0.0
    return _run(stage, folder, key, earlier_s, display)


def _require_ours(folder: Path) -> None:
    """Raise instead of replacing files that no stage wrote."""
    if folder.exists() and not (folder / RECORD).exists() and any(folder.iterdir()):
        raise StageError(
            f"expected {folder} to be a stage's folder, got files that no stage wrote; move them, or name another run folder"
        )


def _run(stage: Stage, folder: Path, key: str, earlier_s: float, display: StageDisplay) -> Artefact:
    folder.mkdir(parents=True, exist_ok=True)
    settings = stage.settings.resolved
    write_artefact(folder, Artefact(key, None, earlier_s, settings))
    report = display.start(stage.name)
    begin = time.monotonic()
    try:
        stage.run(folder, report)
    except BaseException:
        write_artefact(folder, Artefact(key, None, earlier_s + time.monotonic() - begin, settings))
        raise
    record = Artefact(key, digest_of(folder), earlier_s + time.monotonic() - begin, settings)
    write_artefact(folder, record)
    display.finish(stage.name, record.seconds, cached=False)
    return record
