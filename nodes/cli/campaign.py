"""The commands ``advnerf campaign ...``: many attacks over cores or machines, and the table they make."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nodes.runtime.terminal import Overrides, print_table, say_error, table
from nodes.runtime.termination import ends_in_order

if TYPE_CHECKING:
    from advnerf_core.report.transfer import TransferTable
    from nodes.experiment.campaign.config import Campaign
from nodes.experiment.cell import Cell

app = typer.Typer(
    no_args_is_help=True,
    help="Many attacks over cores and machines, resumed where they were left, and the table they make.",
)

File = Annotated[Path, typer.Argument(help="A *.campaign.yaml file.", exists=True, dir_okay=False)]
Folder = Annotated[
    Path | None,
    typer.Option(
        "--folder", help="Folder of the cells.", show_default="the file's, or runs/campaigns/<name>"
    ),
]
Only = Annotated[
    str,
    typer.Option(
        "--only",
        metavar="KEY=VALUE,...",
        help="Only these cells, e.g. scenario=straight+left,method=gradient.",
    ),
]
_COLOURS = {
    "done": "green",
    "failed": "red",
    "unreadable": "red",
    "changed": "yellow",
    "running": "cyan",
    "begun": "cyan",
}
_FAILURE_EXIT = 1


def _load(
    file: Path, folder: Path | None, overrides: list[str] | None, only: str
) -> tuple[Campaign, list[Cell]]:
    from nodes.experiment.campaign.config import load_campaign
    from nodes.experiment.cell import select

    campaign = load_campaign(file, folder, tuple(overrides or ()))
    return campaign, select(campaign.cells, only)


@app.command()
def run(
    file: File,
    folder: Folder = None,
    only: Only = "",
    jobs: Annotated[
        int | None, typer.Option("--jobs", min=1, help="Cells at a time.", show_default="one per core")
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(
            "--threads", min=1, help="Threads per cell.", show_default="cores shared among the jobs"
        ),
    ] = None,
    backend: Annotated[
        str, typer.Option("--backend", help="local: the cores of this machine; ray: a cluster.")
    ] = "local",
    address: Annotated[
        str,
        typer.Option(
            "--address", help="Of a running Ray cluster.", show_default="RAY_ADDRESS, or one started here"
        ),
    ] = "",
    retry: Annotated[bool, typer.Option("--retry", help="Also run cells that failed before.")] = False,
    gate: Annotated[
        bool,
        typer.Option(
            "--gate/--no-gate", help="Leave out scenarios whose surrogate the fidelity gate refuses."
        ),
    ] = True,
    search_only: Annotated[
        bool,
        typer.Option(
            "--search-only", help="Search and deploy nothing yet, so that transfer can be predicted first."
        ),
    ] = False,
    overrides: Overrides = None,
) -> None:
    """Run the cells that are not there yet, and print the table; each is kept when it is finished, so that a run may be stopped at any time."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    from nodes.experiment.campaign.run import Options, run_campaign
    from nodes.runtime.errors import ConfigError

    if backend not in ("local", "ray"):
        raise ConfigError(f"expected --backend local or ray, got {backend!r}")
    campaign, cells = _load(file, folder, overrides, only)
    options = Options(jobs or 0, threads or 0, backend, address, retry, gate, search_only)  # type: ignore[arg-type]
    with ends_in_order():
        ended = run_campaign(campaign, cells, options, lambda text: print(text, flush=True))
    wrong = [end for end in ended if end.how != "done"]
    if not search_only:
        _show_table(campaign, campaign.cells, _page_folder(campaign))
    for end in wrong:
        say_error(f"{end.name}: {end.text}")
    if wrong:
        raise typer.Exit(_FAILURE_EXIT)


@app.command()
def status(file: File, folder: Folder = None, only: Only = "", overrides: Overrides = None) -> None:
    """Say which cells are done, running, failed (and why), made with other settings, or missing."""
    from nodes.experiment.campaign.run import statuses

    campaign, cells = _load(file, folder, overrides, only)
    found = statuses(campaign, cells)
    rows = table("cell", "state", "")
    for each in found:
        colour = _COLOURS.get(each.state, "dim")
        rows.add_row(each.cell.name, f"[{colour}]{each.state}[/]", each.text)
    print_table(rows)
    counts: Any = Counter(each.state for each in found)
    print(
        ", ".join(f"{count} {state}" for state, count in counts.most_common())
        + f" of {len(found)} cells in {campaign.folder}"
    )


@app.command(name="table")
def table_command(
    file: File,
    folder: Folder = None,
    only: Only = "",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Folder of the page.",
            show_default="table in the campaign's folder; with --only or --from, no page is written",
        ),
    ] = None,
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="Show the cells that were published there, e.g. in docs/results, wherever they were run.",
            show_default="the campaign's own cells",
        ),
    ] = None,
    overrides: Overrides = None,
) -> None:
    """Print the transfer table and the targets, and write them as JSON, CSV, Markdown and a page with the clips by outcome."""
    campaign, cells = _load(file, folder, overrides, only)
    if source is not None:
        _show_published(campaign, cells, output, source / campaign.config.name)
        return
    # A page of some cells never takes the place of the page of all.
    _show_table(campaign, cells, output or (None if only else _page_folder(campaign)))


def _page_folder(campaign: Campaign) -> Path:
    return campaign.folder / "table"


def _show_table(campaign: Campaign, cells: list[Cell], output: Path | None) -> None:
    from nodes.experiment.campaign.run import statuses
    from nodes.experiment.campaign.table import campaign_table

    found = statuses(campaign, cells)
    full = campaign_table(campaign, found)
    page = _write_and_print(full, campaign.folder, campaign.folder / "cells", output)
    left_out = [each for each in found if each.state in ("changed", "unreadable")]
    for each in left_out:
        say_error(f"{each.cell.name} is left out: {each.text}")
    _say_where(full, cells, page)


def _show_published(campaign: Campaign, cells: list[Cell], output: Path | None, folder: Path) -> None:
    from nodes.experiment.campaign.published import published_table

    full = published_table(folder, campaign, cells)
    # Films are not published; those of the campaign's own cells may be of other drives.
    _say_where(full, cells, _write_and_print(full, folder, folder, output))


def _write_and_print(
    full: TransferTable, folder: Path, clips_folder: Path, output: Path | None
) -> Path | None:
    """Table, targets and the predictions in ``folder`` to the terminal, and the page into ``output`` if it is asked for."""
    from rich.console import Console

    from advnerf_core.files import write_atomically
    from advnerf_core.report.transfer_page import target_table, text_table
    from advnerf_core.report.transfer_prediction import prediction_section, prediction_table, skill_text
    from advnerf_core.report.transfer_targets import table_targets
    from nodes.experiment.campaign.predictions import predicted
    from nodes.experiment.campaign.table import write_table

    pairs = predicted(folder, list(full.cells.values()))
    page = None
    if output is not None:
        sections = [("Predicted and measured transfer", prediction_section(pairs))] if pairs else []
        page = write_table(full, clips_folder, output, sections)
        if pairs:
            write_atomically(
                output / "predictions.json", json.dumps([pair.record() for pair in pairs], indent=1) + "\n"
            )
    console = Console(width=None if sys.stdout.isatty() else 200)
    console.print(text_table(full).rich())
    console.print(target_table(table_targets(full)).rich())
    if pairs:
        console.print(prediction_table(pairs).rich())
        print(skill_text(pairs))
    return page


def _say_where(full: TransferTable, cells: list[Cell], page: Path | None) -> None:
    print(
        f"{len(full.cells)} of {len(cells)} cells; "
        + (f"page: {page}" if page else "-o FOLDER writes a page of them")
    )


@app.command()
def predict(
    file: File,
    folder: Folder = None,
    only: Only = "",
    draws: Annotated[int, typer.Option("--draws", min=2, help="Drives per prediction.")] = 6,
    overrides: Overrides = None,
) -> None:
    """Predict how the attacks transfer from pictures without a deployed drive with them; the table then says how good that was."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    from nodes.experiment.campaign.predictions import predict_campaign

    campaign, cells = _load(file, folder, overrides, only)
    with ends_in_order():
        made = predict_campaign(campaign, cells, lambda text: print(text, flush=True), draws)
    print(f"{made} predictions made")


@app.command()
def maps(
    file: File,
    folder: Folder = None,
    only: Only = "",
    number: Annotated[int, typer.Option("--object", min=0, help="Which object is moved.")] = 0,
    overrides: Overrides = None,
) -> None:
    """Draw the loss landscape and the robustness map (starts x moves of an object) of finished cells that have placed objects."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    from nodes.experiment.campaign.maps import map_cells

    campaign, cells = _load(file, folder, overrides, only)
    for picture in map_cells(campaign, cells, number):
        print(picture)


@app.command()
def publish(
    file: File,
    folder: Folder = None,
    only: Only = "",
    to: Annotated[Path, typer.Option("--to", help="Gets a folder with the campaign's name.")] = Path(
        "docs/results"
    ),
    prune: Annotated[
        bool, typer.Option("--prune", help="Remove cells there that other settings have made.")
    ] = False,
    overrides: Overrides = None,
) -> None:
    """Copy the finished cells to where they are kept with the code."""
    from nodes.experiment.campaign.published import publish as copy_cells
    from nodes.experiment.campaign.run import statuses

    campaign, cells = _load(file, folder, overrides, only)
    found = copy_cells(campaign, statuses(campaign, cells), to, prune)
    for name in found.written:
        print(f"{to / campaign.config.name / name}.json")
    unfinished = len(cells) - len(found.written) - len(found.same)
    print(f"{len(found.written)} cells written, {len(found.same)} were there, {unfinished} are not finished")
    if found.stale:
        what = "were made with other settings and " + (
            "are removed" if prune else "stay, until --prune removes them"
        )
        print(f"{len(found.stale)} of those there {what}: {', '.join(found.stale)}")


@app.command()
def restore(
    file: File,
    folder: Folder = None,
    only: Only = "",
    source: Annotated[
        Path, typer.Option("--from", help="Has a folder with the campaign's name, as publish makes it.")
    ] = Path("docs/results"),
    overrides: Overrides = None,
) -> None:
    """Take published cells back into a campaign's folder that was lost: those of these settings, scenes and policies. Nothing is run."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    from nodes.experiment.campaign.published import restore as take_back

    campaign, cells = _load(file, folder, overrides, only)
    found = take_back(campaign, cells, source)
    for name in found.taken:
        print(campaign.folder / "cells" / f"{name}.json")
    print(
        f"{len(found.taken)} cells taken back, {len(found.there)} were there, {len(found.other)} were made with other settings, scenes or "
        f"policies than are there, {len(found.missing)} are not published"
    )
