"""The cells in a run folder: one JSON per finished cell, one work folder per cell, locks, and errors of failed cells."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal

from advnerf_core.files import write_json
from advnerf_core.report.cells import CellError, CellResult, cell_from, read_cell
from nodes.experiment.engine.artefact import Settings, has_key, read_current, write_key
from nodes.experiment.plan.cell import Cell
from nodes.runtime.locks import HeldError, hold

State = Literal["done", "not driven live", "failed", "changed", "running", "begun", "missing", "unreadable"]
NOT_DRIVEN: State = "not driven live"
FINISHED = ("done", NOT_DRIVEN)
_KEY, _ERROR = "key.json", "error.json"
LOG = "log.txt"


@dataclass(frozen=True)
class CellStatus:
    """State of one cell.

    Attributes:
        state: ``not driven live``: searched, but all its live tries were spoiled; ``changed``: a result exists, but with other settings;
            ``begun``: interrupted, and resumed by the next run.
        text: Error, or the last line of its log.
        result: The result, with any settings; None without one.
        file: File of the result of a finished cell, or of one that was not driven live.
    """

    cell: Cell
    state: State
    text: str = ""
    result: CellResult | None = None
    file: Path | None = None


@dataclass(frozen=True)
class Store:
    """The run folder of an experiment."""

    folder: Path

    def result_file(self, name: str) -> Path:
        """File of a cell's result."""
        return self.folder / "cells" / f"{name}.json"

    def work(self, name: str) -> Path:
        """Work folder of a cell."""
        return self.folder / "cells" / name

    def lock_file(self, name: str) -> Path:
        """Lock file that the process of the cell holds."""
        return self.folder / "locks" / name

    def result(self, name: str) -> CellResult | None:
        """A cell's result; None without one."""
        file = self.result_file(name)
        return read_cell(file) if file.exists() else None

    def keep_result(self, name: str, data: dict[str, Any]) -> CellResult:
        """Check a cell's result and write it; the error of an earlier attempt is removed."""
        result = cell_from(data, f"the result of {name}")
        write_json(self.result_file(name), data)
        (self.work(name) / _ERROR).unlink(missing_ok=True)
        return result

    def error(self, name: str, settings_hash: str) -> str:
        """Error of the cell with these settings; empty if it did not fail."""
        kept = read_current(self.work(name) / _ERROR, settings_hash=settings_hash)
        return "" if kept is None else str(kept.get("error", ""))

    def keep_error(self, name: str, settings_hash: str, error: str) -> None:
        """Note that the cell failed."""
        date = datetime.now(timezone.utc).isoformat(timespec="seconds")
        data = {"error": error, "settings_hash": settings_hash, "date": date}
        write_json(self.work(name) / _ERROR, data)

    def begin(self, name: str, settings_hash: str, settings: Settings) -> Path:
        """The cell's folder, emptied unless work with the same settings was begun there."""
        work = self.work(name)
        if not self.has_begun(name, settings_hash):
            shutil.rmtree(work, ignore_errors=True)
        (work / _ERROR).unlink(missing_ok=True)
        write_key(work / _KEY, settings_hash, settings)
        return work

    def has_begun(self, name: str, settings_hash: str) -> bool:
        """Whether the content of the cell's folder belongs to these settings."""
        return has_key(self.work(name) / _KEY, settings_hash)

    def status(
        self, cell: Cell, settings_hash: str | None, elsewhere: Sequence[Path] = (), changed: str = ""
    ) -> CellStatus:
        """State of a cell.

        Args:
            settings_hash: Hash of the current settings; None if it is unknown yet, because the cell's inputs do not exist, or changed.
            elsewhere: Further files that may have this cell's result: one with the same key counts as finished.
            changed: What to say of a result with other settings; empty if no more is known.
        """
        name = cell.name
        if self._is_held(name):
            return CellStatus(cell, "running", self._last_line(name))
        try:
            result = self.result(name)
        except CellError as broken:
            return CellStatus(cell, "unreadable", str(broken))
        ours = result if result is not None and result.settings_hash == settings_hash else None
        if ours is not None and not ours.not_driven_live:
            return CellStatus(cell, "done", "", ours, self.result_file(name))
        if settings_hash is not None and (found := _first_of(elsewhere, settings_hash)) is not None:
            file, other = found
            return CellStatus(cell, "done", f"from {file}", _named(other, cell), file)
        if ours is not None:
            return CellStatus(cell, NOT_DRIVEN, ours.not_driven_live, ours, self.result_file(name))
        if settings_hash is not None and (error := self.error(name, settings_hash)):
            return CellStatus(cell, "failed", error, result)
        if result is not None:
            return CellStatus(cell, "changed", changed or "of other settings", result)
        begun = settings_hash is not None and self.has_begun(name, settings_hash)
        return CellStatus(cell, "begun" if begun else "missing", self._last_line(name) if begun else "")

    def _is_held(self, name: str) -> bool:
        if not self.lock_file(name).exists():
            return False
        try:
            hold(self.lock_file(name)).close()
        except HeldError:
            return True
        return False

    def _last_line(self, name: str) -> str:
        try:
            lines = (
                (self.work(name) / LOG).read_bytes()[-2000:].decode("utf-8", "replace").strip().splitlines()
            )
        except OSError:
            return ""
        return lines[-1][:200] if lines else ""


def _first_of(files: Sequence[Path], settings_hash: str) -> tuple[Path, CellResult] | None:
    """The first readable result with these settings."""
    for file in files:
        try:
            result = read_cell(file)
        except CellError:
            continue
        if result.settings_hash == settings_hash and not result.not_driven_live:
            return file, result
    return None


def _named(result: CellResult, cell: Cell) -> CellResult:
    """A result under its name here: the variant's own run folder uses the name of its path."""
    return result.model_copy(update={"scenario": cell.scenario})
