"""The commands ``advnerf experiment status``, ``table`` and ``report``: how far cells are, and their table."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nodes.cli.cell_choice import CellChoice, know_methods, load_cells
from nodes.runtime.terminal import coloured, print_table, say_error, table

if TYPE_CHECKING:
    from advnerf_core.report.result_table import ResultTable
    from nodes.experiment.plan.cell import Cell
    from nodes.experiment.show.context import Experiment

Published = Annotated[
    bool,
    typer.Option(
        "--published",
        help="Of the cells that were published, whatever their settings; --folder is then that of all published sets (docs/results).",
    ),
]
_PUBLISHED = Path("docs/results")
_COLOURS = {
    "done": "green",
    "not driven live": "yellow",
    "failed": "red",
    "unreadable": "red",
    "changed": "yellow",
    "running": "cyan",
    "begun": "cyan",
}


def status(choice: CellChoice) -> None:
    """Say which cells are done, running, failed (and why), made with other settings, or missing."""
    from nodes.experiment.run.plan import statuses

    experiment, cells = load_cells(choice, executes=False)
    found = statuses(experiment, cells)
    rows = table("cell", "state", "")
    for each in found:
        colour = _COLOURS.get(each.state, "dim")
        rows.add_row(each.cell.name, coloured(each.state, colour), each.text)
    print_table(rows)
    counts: Any = Counter(each.state for each in found)
    print(
        ", ".join(f"{count} {state}" for state, count in counts.most_common())
        + f" of {len(found)} cells in {experiment.folder}"
    )


def table_command(
    choice: CellChoice,
    published: Published = False,
) -> None:
    """Print the table of all cells, and the targets."""
    choice, source = _published(choice, published)
    experiment, cells = load_cells(choice, executes=False)
    show_table(experiment, cells, None, source)


def report(
    choice: CellChoice,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Folder of the page.", show_default="table in the folder of the cells"
        ),
    ] = None,
    published: Published = False,
) -> None:
    """Write the table as JSON, CSV, Markdown and a page with the films by outcome, and print it."""
    from nodes.runtime.errors import ConfigError

    if choice.only and output is None:
        raise ConfigError(
            "expected --output with --only, as the page of some cells would replace that of all"
        )
    choice, source = _published(choice, published)
    experiment, cells = load_cells(choice, executes=False)
    show_table(experiment, cells, output or page_folder(experiment), source)


def _published(choice: CellChoice, published: bool) -> tuple[CellChoice, Path | None]:
    """The choice of cells, and the folder of their published sets; None for cells of the run folder."""
    if not published:
        return choice, None
    return replace(choice, folder=None), choice.folder or _PUBLISHED


def page_folder(experiment: Experiment) -> Path:
    """Where the page of all cells of an experiment goes."""
    return experiment.folder / "table"


def show_table(
    experiment: Experiment, cells: Sequence[Cell], output: Path | None, source: Path | None = None
) -> None:
    """Print the table of cells; write its page into ``output`` if it is given.

    The cells are those of the settings of now, or in ``source``, the folder of published sets, whatever their settings.
    """
    from nodes.experiment.run.plan import statuses
    from nodes.experiment.run.published import published_table, table_of

    left_out = []
    if source is None:
        know_methods(experiment)  # titles are kept since cells were run
        found = statuses(experiment, cells)
        left_out = [each for each in found if each.state in ("changed", "unreadable")]
        full, folder, clips = table_of(experiment, found), experiment.folder, experiment.folder / "cells"
    else:
        # Films are not published; films of the user's own cells may show other drives.
        folder = clips = source / experiment.config.name
        full = published_table(folder, experiment, list(cells))
    page = _write_and_print(experiment, full, folder, clips, output)
    for each in left_out:
        say_error(f"{each.cell.name} is left out: {each.text}")
    told = f"page: {page}" if page else "advnerf experiment report writes a page of them"
    print(f"{len(full.cells)} of {len(cells)} cells; {told}")


def _write_and_print(
    experiment: Experiment, full: ResultTable, folder: Path, clips_folder: Path, output: Path | None
) -> Path | None:
    """Table, targets and the predictions in ``folder`` to the terminal, and the page into ``output`` if it is asked for."""
    from advnerf_core.files import write_json
    from advnerf_core.report.predictions import prediction_section, prediction_table, skill_text
    from advnerf_core.report.result_page import maximised_table, text_table
    from advnerf_core.report.targets import evaluate, target_table
    from nodes.experiment.pages.table import write_table
    from nodes.experiment.run.predictions import predicted
    from nodes.runtime.console import plain_console

    pairs = predicted(folder, list(full.cells.values()))
    targets = evaluate(experiment.held_to.targets, full)
    page = None
    if output is not None:
        sections = [("Predicted and measured transfer", prediction_section(pairs))] if pairs else []
        page = write_table(full, clips_folder, output, sections, targets=targets)
        if pairs:
            write_json(output / "predictions.json", [asdict(pair) for pair in pairs])
    console = plain_console(width=None if sys.stdout.isatty() else 200)
    console.print(text_table(full).rich())
    if (goals := maximised_table(full)) is not None:
        console.print(goals.rich())
    if targets:
        console.print(target_table(targets).rich())
    if pairs:
        console.print(prediction_table(pairs).rich())
        print(skill_text(pairs))
    return page
