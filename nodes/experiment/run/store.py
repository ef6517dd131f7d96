"""The cells in a run folder: one JSON per finished cell, one folder of work per cell, locks, and errors of what failed."""

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
    """Where one cell is.

    Attributes:
        cell: Which.
        state: ``not driven live``: searched, but all its live tries were spoiled; ``changed``: there is a result, but of other settings;
            ``begun``: stopped on the way, goes on when run.
        text: Error, or the last line of its log.
        result: The result, of any settings; None where there is none.
        file: Where the result of a done cell is, or of one that was not driven live.
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
        """A cell's result."""
        return self.folder / "cells" / f"{name}.json"

    def work(self, name: str) -> Path:
        """A cell's folder of work."""
        return self.folder / "cells" / name

    def lock_file(self, name: str) -> Path:
        """Held by the process that runs the cell."""
        return self.folder / "locks" / name

    def result(self, name: str) -> CellResult | None:
        """A cell's result; None where there is none."""
        file = self.result_file(name)
        return read_cell(file) if file.exists() else None

    def keep_result(self, name: str, data: dict[str, Any]) -> CellResult:
        """Check a cell's result and write it; the error of an earlier attempt goes."""
        result = cell_from(data, f"the result of {name}")
        write_json(self.result_file(name), data)
        (self.work(name) / _ERROR).unlink(missing_ok=True)
        return result

    def error(self, name: str, settings_hash: str) -> str:
        """Why the cell failed with these settings; empty if it did not."""
        kept = read_current(self.work(name) / _ERROR, settings_hash=settings_hash)
        return "" if kept is None else str(kept.get("error", ""))

    def keep_error(self, name: str, settings_hash: str, error: str) -> None:
        """Note that the cell failed."""
        date = datetime.now(timezone.utc).isoformat(timespec="seconds")
        data = {"error": error, "settings_hash": settings_hash, "date": date}
        write_json(self.work(name) / _ERROR, data)

    def begin(self, name: str, settings_hash: str, settings: Settings) -> Path:
        """The cell's folder, empty unless work on the same settings was begun there."""
        work = self.work(name)
        if not self.has_begun(name, settings_hash):
            shutil.rmtree(work, ignore_errors=True)
        (work / _ERROR).unlink(missing_ok=True)
        write_key(work / _KEY, settings_hash, settings)
        return work

    def has_begun(self, name: str, settings_hash: str) -> bool:
        """Whether what is in the cell's folder is of these settings."""
        return has_key(self.work(name) / _KEY, settings_hash)

    def status(self, cell: Cell, settings_hash: str | None, elsewhere: Sequence[Path] = ()) -> CellStatus:
        """Where a cell is.

        Args:
            cell: Which.
            settings_hash: Of the settings as they are; None if they cannot be known yet, as what the cell needs is not made.
            elsewhere: Files where this cell may be too: one whose key matches is done, wherever it was run.
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
            return CellStatus(cell, "changed", "of other settings", result)
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
    """The first readable result of these settings."""
    for file in files:
        try:
            result = read_cell(file)
        except CellError:
            continue
        if result.settings_hash == settings_hash and not result.not_driven_live:
            return file, result
    return None


def _named(result: CellResult, cell: Cell) -> CellResult:
    """A result under the name that it has here: the variant's own run folder has it under the name of its path."""
    return result.model_copy(update={"scenario": cell.scenario})
