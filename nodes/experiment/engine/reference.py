"""The reference build: what stages made, kept with the code and found by its key.

With it a machine that has only the repository goes on where another stopped: it has the very scene, victims and objects that the
published cells were run with. One folder per stage, named by stage and key; of two with the same
files one has them, and the record of the other names it. Left out is bulk (`Stage.bulk`), as photographs and
training frames are, which only a stage that is made anew reads; then those that it reads are made anew as well.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from advnerf_core.errors import AdvnerfError
from advnerf_core.report.evidence import kept_build
from nodes.experiment.engine.stage_record import (
    RECORD,
    Stage,
    StageRecord,
    digest_of,
    key_of,
    read_record,
    write_record,
)
from nodes.runtime.paths import shipped

# Where cells and stages are kept with the code.
PUBLISHED = Path("docs/results")
BUILD = kept_build.BUILD
_KEY_DIGITS = 16


class ReferenceBuildError(AdvnerfError):
    """A reference build is damaged."""


@dataclass(frozen=True)
class ReferenceBuild:
    """A folder of stages that are kept with the code.

    Attributes:
        folder: Holds one folder for each; need not exist.
        shipped: Where stages are read that are not in ``folder``.
    """

    folder: Path
    shipped: Path | None = None

    def record(self, stage: Stage, key: str) -> StageRecord | None:
        """What is known of a stage with a key; None if it is not here."""
        found = read_record(self._source(stage, key))
        return found if found is not None and found.key == key else None

    def digests(self, stages: Sequence[Stage], folder: Path) -> dict[str, str]:
        """Digests of what stages wrote, as far as a run folder has them, or else this reference build.

        Args:
            stages: The stages, each after those it names in ``after``.
            folder: The run folder.
        """
        records: dict[str, StageRecord] = {}
        for stage in stages:
            if any(name not in records for name in stage.after):
                continue
            found = read_record(folder / stage.name) or self.record(stage, key_of(stage, records))
            if found is not None and found.digest is not None:
                records[stage.name] = found
        return {name: str(record.digest) for name, record in records.items()}

    def take(self, stage: Stage, key: str, folder: Path) -> StageRecord | None:
        """Copy a stage from here into its folder in a run folder, replacing what is there.

        Returns:
            Its record; None if it is not here.

        Raises:
            ReferenceBuildError: Its files are not those that were kept.
        """
        source, record = self._source(stage, key), self.record(stage, key)
        if record is None:
            return None
        if record.files_in:
            source = source.with_name(record.files_in)
            record = replace(record, files_in="")
        if digest_of(source) != record.kept:
            raise ReferenceBuildError(
                f"expected the files in {source} as they were kept, got others; restore them (git checkout -- {source}), or remove the folder to "
                "have the stage made anew"
            )
        _copy(source, folder, (), record)
        return record

    def keep(self, stage: Stage, key: str, folder: Path) -> Path | None:
        """Copy a finished stage from its folder in a run folder to here.

        Returns:
            Where it is now; None if it was here, or the folder has no finished stage of this key.
        """
        record, target = read_record(folder), self._at(stage, key)
        if (
            record is None
            or record.key != key
            or record.digest is None
            or self.record(stage, key) is not None
        ):
            return None
        _copy(folder, target, stage.bulk, record)
        self._share(target)
        return target

    def _share(self, target: Path) -> None:
        """Keep the files of a stage once, where another folder of the same stage has the same ones."""
        ours = read_record(target)
        assert ours is not None, "it was kept"
        for file in sorted(self.folder.glob(f"{target.name.rpartition('_')[0]}_*/{RECORD}")):
            other = read_record(file.parent)
            if (
                file.parent != target
                and other is not None
                and (other.kept, other.files_in) == (ours.kept, "")
            ):
                shutil.rmtree(target)
                write_record(target, replace(ours, files_in=file.parent.name))
                return

    def _source(self, stage: Stage, key: str) -> Path:
        at = self._at(stage, key)
        return at if self.shipped is None or at.exists() else self.shipped / at.name

    def _at(self, stage: Stage, key: str) -> Path:
        return self.folder / f"{stage.name}_{key[:_KEY_DIGITS]}"


REFERENCE = ReferenceBuild(PUBLISHED / BUILD, shipped(str(PUBLISHED / BUILD)))


def _copy(source: Path, target: Path, without: Sequence[str], record: StageRecord) -> None:
    """Copy a stage's files, all or none, with a record that says which they are."""
    partial = target.with_name(f".{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    left_out = {path for pattern in without for path in source.glob(pattern)} | {source / RECORD}
    partial.mkdir(parents=True)
    for path in sorted(source.rglob("*")):
        if path.is_file() and left_out.isdisjoint([path, *path.parents]):
            at = partial / path.relative_to(source)
            at.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, at)
    write_record(partial, replace(record, kept=digest_of(partial)))
    shutil.rmtree(target, ignore_errors=True)
    partial.rename(target)
