"""One search for all cells that differ only in their deployment: the first finished one is copied by the others."""

from __future__ import annotations

import shutil
from pathlib import Path

from advnerf_core.files import write_atomically
from nodes.experiment.engine.artefact import has_key, write_key
from nodes.experiment.plan.cell import Cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.keys import cell_settings
from nodes.experiment.steps.search_files import ATTACK, SEARCHED

_KEY = "search_key.json"


def search_key(experiment: Experiment, cell: Cell) -> str:
    """Hash of everything that a search, and the drives in the surrogate past its attack, depend on."""
    return cell_settings(experiment, cell, deployed=False).key


def drop_other_search(experiment: Experiment, cell: Cell, folder: Path) -> None:
    """Remove a cell's folder if its search was of another policy, scene, place or settings: its results are not this cell's."""
    file = folder / _KEY
    if file.exists() and not has_key(file, search_key(experiment, cell)):
        shutil.rmtree(folder)


def take_search(experiment: Experiment, cell: Cell, folder: Path) -> Path | None:
    """Copy the search of a cell whose folder is beside this one's if it is the same, and return that folder.

    Nothing happens if this cell has begun its own. The stages before the cells are finished.
    """
    settings = cell_settings(experiment, cell, deployed=False)
    key = settings.key
    if has_key(folder / _KEY, key):
        return None
    if (found := _finished(folder, key)) is not None:
        # The drives come last: without them the search counts as unfinished.
        for name in (ATTACK, SEARCHED):
            if (found / name).exists():
                write_atomically(folder / name, (found / name).read_bytes())
    write_key(folder / _KEY, key, settings)
    return found


def _finished(folder: Path, key: str) -> Path | None:
    """A folder beside a cell's with the same, finished search."""
    beside = sorted(file for file in folder.parent.glob(f"*/{_KEY}") if file.parent != folder)
    return next(
        (each.parent for each in beside if has_key(each, key) and (each.parent / SEARCHED).exists()), None
    )
