"""The lines of a result table, and its page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from advnerf_core.files import write_atomically
from advnerf_core.report.conditions import order_of
from advnerf_core.report.evidence.rows import Key
from advnerf_core.report.pages import FirstScreen
from advnerf_core.report.result_page import as_csv, as_json, as_markdown, gather_clips, render_page
from advnerf_core.report.result_table import ResultTable
from advnerf_core.report.targets import Target
from nodes.experiment.pages.opening import Wording, opening
from nodes.experiment.plan.cell import Cell


def wanted_rows(cells: Sequence[Cell]) -> dict[Key, list[int]]:
    """The seeds of each line of the cells, in the order in which their paths and variants appear."""
    seeds: dict[Key, list[int]] = {}
    for cell in cells:
        seeds.setdefault((cell.scenario, cell.victim, cell.method), []).append(cell.seed)
    scenarios = list(dict.fromkeys(scenario for scenario, _, _ in seeds))
    # By victim before method: the reader compares the methods on one victim.
    victims = list(dict.fromkeys(victim for _, victim, _ in seeds))
    order = sorted(
        seeds,
        key=lambda key: (scenarios.index(key[0]), victims.index(key[1]), order_of(key[2])),
    )
    return {key: seeds[key] for key in order}


def write_table(
    table: ResultTable,
    cells_folder: Path,
    folder: Path,
    sections: Sequence[tuple[str, Markup]] = (),
    page: str = "index.html",
    targets: Sequence[Target] = (),
    first: FirstScreen | None = None,
    notes: Sequence[str] = (),
) -> Path:
    """Write JSON, CSV, Markdown and the page with the clips beside it; returns the page.

    Args:
        first: Contents of the first screen; None for the sentences of the table alone.
        notes: Paragraphs before the sentence, such as missing methods.
    """
    folder.mkdir(parents=True, exist_ok=True)
    clips = gather_clips(table, cells_folder, folder)
    write_atomically(
        folder / "table.json", json.dumps(as_json(table, targets), indent=1, allow_nan=False) + "\n"
    )
    write_atomically(folder / "table.csv", as_csv(table))
    write_atomically(folder / "table.md", as_markdown(table, targets))
    text = render_page(table, first or opening(table, Wording()), clips, sections, targets, notes)
    write_atomically(folder / page, text)
    return folder / page
