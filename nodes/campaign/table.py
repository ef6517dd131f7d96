"""The table of a campaign from its cells, and copies of the cells that are kept with the code."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from advnerf_core.files import write_atomically
from advnerf_core.report.cells import read_cells
from advnerf_core.report.transfer import TransferTable, Wanted, make_table
from advnerf_core.report.transfer_page import as_csv, as_json, as_markdown, gather_clips, render_transfer_page
from nodes.campaign.config import Campaign, Cell
from nodes.campaign.kinds import load_kind
from nodes.campaign.predictions import kept_prediction, prediction_file
from nodes.campaign.run import gate_key
from nodes.campaign.store import CellStatus, store_of
from nodes.runtime.errors import ConfigError

PUBLISHED = Path("docs/results")


def wanted_rows(campaign: Campaign, cells: Sequence[Cell]) -> list[Wanted]:
    """The lines that some cells of a campaign fill."""
    seeds: dict[tuple[str, str, str, str], list[int]] = {}
    for cell in cells:
        seeds.setdefault((cell.scenario, cell.placement, cell.victim, cell.method), []).append(cell.seed)
    # By victim before method: the reader compares the methods on one victim.
    order = sorted(seeds, key=lambda key: (list(campaign.config.scenarios).index(key[0]), key[1]))
    return [Wanted(*key, tuple(seeds[key])) for key in order]


def campaign_table(campaign: Campaign, found: Sequence[CellStatus]) -> TransferTable:
    """The table of the cells that are there.

    Args:
        campaign: The campaign.
        found: Where the cells are that the table is of; only results of the settings as they are now are taken.
    """
    cells = [each.result for each in found if each.result is not None and each.state == "done"]
    return make_table(wanted_rows(campaign, [each.cell for each in found]), cells, campaign.config.name)


def write_table(
    table: TransferTable, cells_folder: Path, folder: Path, sections: Sequence[tuple[str, Markup]] = ()
) -> Path:
    """Write JSON, CSV, Markdown and the page with the clips beside it.

    Args:
        table: The table.
        cells_folder: Where the cells' clips are.
        folder: Where to write.
        sections: Further parts of the page.

    Returns:
        The page.
    """
    folder.mkdir(parents=True, exist_ok=True)
    clips = gather_clips(table, cells_folder, folder)
    write_atomically(folder / "table.json", json.dumps(as_json(table), indent=1, allow_nan=False) + "\n")
    write_atomically(folder / "table.csv", as_csv(table))
    write_atomically(folder / "table.md", as_markdown(table))
    write_atomically(folder / "index.html", render_transfer_page(table, clips, sections))
    return folder / "index.html"


def publish(campaign: Campaign, found: Sequence[CellStatus], folder: Path) -> tuple[list[str], list[str]]:
    """Copy finished cells to where they are kept with the code, and remove those there that other settings have made.

    The fidelity gate's verdicts and the predictions of these cells go along.

    What lies there of cells that are not begun here stays: they may have been run elsewhere.

    Args:
        campaign: The campaign.
        found: Where its cells are.
        folder: Gets one folder per campaign.

    Returns:
        Names of the cells that are new or changed there, and of those that were the same.
    """
    changed, same = [], []
    for each in found:
        target = folder / campaign.config.name / f"{each.cell.name}.json"
        prediction = prediction_file(folder / campaign.config.name, each.cell.name)
        if each.state == "changed":
            target.unlink(missing_ok=True)
            prediction.unlink(missing_ok=True)
        if each.state != "done":
            continue
        text = _published_text(campaign, each.cell)
        if target.exists() and target.read_text(encoding="utf-8") == text:
            same.append(each.cell.name)
            continue
        write_atomically(target, text)
        changed.append(each.cell.name)
    _publish_beside(campaign, [each for each in found if each.state == "done"], folder / campaign.config.name)
    return changed, same


def _published_text(campaign: Campaign, cell: Cell) -> str:
    """The cell's file, less what its kind keeps for its own maps and is megabytes long."""
    text = store_of(campaign).result_file(cell.name).read_text(encoding="utf-8")
    left_out = load_kind(campaign.config.scenarios[cell.scenario].kind).unpublished
    if not left_out:
        return text
    data = json.loads(text)
    extra = {name: value for name, value in data["extra"].items() if name not in left_out}
    return json.dumps({**data, "extra": extra}, indent=1) + "\n"


def _publish_beside(campaign: Campaign, done: Sequence[CellStatus], folder: Path) -> None:
    for each in done:
        assert each.result is not None, "a finished cell has a result"
        kept = kept_prediction(prediction_file(campaign.folder, each.cell.name), each.result.settings_hash)
        if kept is not None:
            write_atomically(prediction_file(folder, each.cell.name), json.dumps(kept, indent=1) + "\n")
    for name in sorted({f"{gate_key(each.cell)}.json" for each in done}):
        if (verdict := campaign.folder / "gate" / name).exists():
            write_atomically(folder / "gate" / name, verdict.read_text(encoding="utf-8"))


def published_table(folder: Path, campaign: Campaign) -> TransferTable:
    """The table of published cells, with all lines and seeds that the campaign asks for.

    Args:
        folder: Of the published cells.
        campaign: Whose they are.

    Raises:
        ConfigError: There are none.
    """
    cells = read_cells(folder)
    if not cells:
        raise ConfigError(f"expected published cells in {folder}, got none; run advnerf campaign publish")
    return make_table(wanted_rows(campaign, campaign.cells), cells, campaign.config.name)
