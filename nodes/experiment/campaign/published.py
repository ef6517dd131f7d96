"""Cells that are kept with the code: copied there when they are finished, taken back where the campaign's own folder was lost."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.files import write_atomically
from advnerf_core.report.cells import CellResult, read_cell, read_cells
from advnerf_core.report.transfer import TransferTable, make_table
from nodes.experiment.campaign.config import Campaign
from nodes.experiment.campaign.predictions import kept_prediction, prediction_file
from nodes.experiment.campaign.run import gate_file, gate_key, hash_as_it_is
from nodes.experiment.campaign.store import CellStatus, store_of
from nodes.experiment.campaign.table import wanted_rows
from nodes.experiment.cell import Cell
from nodes.runtime.errors import ConfigError

PUBLISHED = Path("docs/results")


@dataclass(frozen=True)
class Published:
    """What became of the cells that were published, by name.

    Attributes:
        written: New or changed there.
        same: There already.
        stale: There, but of other settings than those of now, as is what the campaign's own folder has.
    """

    written: tuple[str, ...]
    same: tuple[str, ...]
    stale: tuple[str, ...]


@dataclass(frozen=True)
class Restored:
    """What became of the cells that were to be taken back, by name.

    Attributes:
        taken: Now finished in the campaign's folder.
        there: Finished there already.
        other: Kept with the code, but made with other settings, or with a scene or a policy that was made anew since or is not there.
        missing: Not kept.
    """

    taken: tuple[str, ...] = ()
    there: tuple[str, ...] = ()
    other: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()


def publish(campaign: Campaign, found: Sequence[CellStatus], folder: Path, prune: bool = False) -> Published:
    """Copy finished cells to where they are kept with the code, with the fidelity gate's verdicts and the predictions of these cells.

    What lies there of cells that are not finished here stays: they may have been run elsewhere.

    Args:
        campaign: The campaign.
        found: Where its cells are.
        folder: Gets one folder per campaign.
        prune: Remove what lies there of cells whose results here are of other settings too.
    """
    written, same, stale = [], [], []
    for each in found:
        target = folder / campaign.config.name / f"{each.cell.name}.json"
        if each.state == "changed" and _is_of(target, each.result):
            stale.append(each.cell.name)
            if prune:
                target.unlink()
                prediction_file(folder / campaign.config.name, each.cell.name).unlink(missing_ok=True)
        if each.state != "done":
            continue
        text = store_of(campaign).result_file(each.cell.name).read_text(encoding="utf-8")
        if target.exists() and target.read_text(encoding="utf-8") == text:
            same.append(each.cell.name)
            continue
        write_atomically(target, text)
        written.append(each.cell.name)
    _publish_beside(campaign, [each for each in found if each.state == "done"], folder / campaign.config.name)
    return Published(tuple(written), tuple(same), tuple(stale))


def _is_of(published: Path, result: CellResult | None) -> bool:
    """Whether a published cell is that result, and not one of newer settings from elsewhere."""
    return (
        result is not None
        and published.exists()
        and read_cell(published).settings_hash == result.settings_hash
    )


def _publish_beside(campaign: Campaign, done: Sequence[CellStatus], folder: Path) -> None:
    for each in done:
        assert each.result is not None, "a finished cell has a result"
        kept = kept_prediction(prediction_file(campaign.folder, each.cell.name), each.result.settings_hash)
        if kept is not None:
            write_atomically(prediction_file(folder, each.cell.name), json.dumps(kept, indent=1) + "\n")
    for key in sorted({gate_key(each.cell) for each in done}):
        for drive in (False, True):
            if (verdict := gate_file(campaign.folder, key, drive)).exists():
                write_atomically(gate_file(folder, key, drive), verdict.read_text(encoding="utf-8"))


def published_table(folder: Path, campaign: Campaign, cells: Sequence[Cell] | None = None) -> TransferTable:
    """The table of published cells, with all lines and seeds that are asked for.

    Args:
        folder: Of the published cells.
        campaign: Whose they are.
        cells: Which of them the table is of; None for all of the campaign.

    Raises:
        ConfigError: There are none.
    """
    found = read_cells(folder)
    if not found:
        raise ConfigError(f"expected published cells in {folder}, got none; run advnerf campaign publish")
    return make_table(
        wanted_rows(campaign, campaign.cells if cells is None else cells), found, campaign.config.name
    )


def restore(campaign: Campaign, cells: Sequence[Cell], folder: Path) -> Restored:
    """Take published cells back into the campaign's folder, with their predictions; its work, films included, does not come back.

    Only what would be the same if it were run: settings and the outputs of capture, scene, object and policy, by hash. These must be there.

    Args:
        campaign: The campaign.
        cells: Which of its cells.
        folder: Of all published campaigns.

    Raises:
        CellError: What is kept there is no cell.
    """
    store, kept = store_of(campaign), folder / campaign.config.name
    experiments: dict[tuple[str, str], Any] = {}
    became: dict[str, list[str]] = {}
    for cell in cells:
        digest, file = hash_as_it_is(campaign, cell, experiments), kept / f"{cell.name}.json"
        if store.status(cell, digest).state in ("done", "running"):
            how = "there"
        elif not file.exists():
            how = "missing"
        elif digest is None or read_cell(file).settings_hash != digest:
            how = "other"
        else:
            how = "taken"
            store.keep_result(cell.name, json.loads(file.read_text(encoding="utf-8")))
            prediction = kept_prediction(prediction_file(kept, cell.name), digest)
            if prediction is not None:
                text = json.dumps(prediction, indent=1) + "\n"
                write_atomically(prediction_file(campaign.folder, cell.name), text)
        became.setdefault(how, []).append(cell.name)
    return Restored(**{how: tuple(names) for how, names in became.items()})
