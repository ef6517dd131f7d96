"""The commands ``advnerf campaign ...``: many attacks over cores or machines, and the table they make."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nodes.runtime.terminal import Overrides, print_table, say_error, table

if TYPE_CHECKING:
    from nodes.campaign.config import Campaign, Cell

app = typer.Typer(
    no_args_is_help=True,
    help="Many attacks over cores and machines, resumed where they were left, and the table they make.",
)

File = Annotated[Path, typer.Argument(help="A *.campaign.yaml file.", exists=True, dir_okay=False)]
Folder = Annotated[
    Path | None,
    typer.Option("--folder", help="Folder of the cells.", show_default="the file's, or runs/campaigns/<name>"),
]
Only = Annotated[
    str,
    typer.Option(
        "--only", metavar="KEY=VALUE,...", help="Only these cells, e.g. scenario=straight+left,method=gradient."
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


def _load(file: Path, folder: Path | None, overrides: list[str] | None, only: str) -> tuple[Campaign, list[Cell]]:
    from nodes.campaign.config import load_campaign, select

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
        typer.Option("--threads", min=1, help="Threads per cell.", show_default="cores shared among the jobs"),
    ] = None,
    backend: Annotated[
        str, typer.Option("--backend", help="local: the cores of this machine; ray: a cluster.")
    ] = "local",
    address: Annotated[
        str,
        typer.Option("--address", help="Of a running Ray cluster.", show_default="RAY_ADDRESS, or one started here"),
    ] = "",
    retry: Annotated[bool, typer.Option("--retry", help="Also run cells that failed before.")] = False,
    overrides: Overrides = None,
) -> None:
    """Run the cells that are not there yet; each is kept when it is finished, so that a run may be stopped at any time."""
    from nodes.campaign.run import Options, run_campaign
    from nodes.runtime.errors import ConfigError

    if backend not in ("local", "ray"):
        raise ConfigError(f"expected --backend local or ray, got {backend!r}")
    campaign, cells = _load(file, folder, overrides, only)
    options = Options(jobs or 0, threads or 0, backend, address, retry)  # type: ignore[arg-type]
    ended = run_campaign(campaign, cells, options, lambda text: print(text, flush=True))
    wrong = [end for end in ended if end.how != "done"]
    for end in wrong:
        say_error(f"{end.name}: {end.text}")
    if wrong:
        raise typer.Exit(_FAILURE_EXIT)


@app.command()
def status(file: File, folder: Folder = None, only: Only = "", overrides: Overrides = None) -> None:
    """Say which cells are done, running, failed (and why), made with other settings, or missing."""
    from nodes.campaign.run import statuses

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
