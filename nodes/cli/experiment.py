"""The commands of experiments: run one, or many in one table; say how far they are; print the table; write the page."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from nodes.runtime.options import with_groups
from nodes.runtime.terminal import Device, Overrides, experiment_argument, print_table, say_error, table
from nodes.runtime.termination import ends_in_order

if TYPE_CHECKING:
    from advnerf_core.report.result_table import ResultTable
    from nodes.experiment.engine.progress_record import ProgressRecord
    from nodes.experiment.plan.cell import Cell
    from nodes.experiment.run.config import Campaign
    from nodes.experiment.run.published import PublishedBuild
    from nodes.experiment.run.run import Options
    from nodes.experiment.run.worker import Ended

File = Annotated[
    Path,
    typer.Argument(
        metavar="FILE|NAME",
        help="A *.experiment.yaml file, or a *.campaign.yaml file that lists several, or the name of one.",
        parser=experiment_argument,
    ),
]
Setting = Annotated[
    str, typer.Option("--setting", help="Which of the experiment file's settings; a campaign names them.")
]
Folder = Annotated[
    Path | None,
    typer.Option(
        "--run-folder",
        help="Folder of all results.",
        show_default="runs/<setting>; of a campaign the file's, or runs/campaigns/<name>",
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


@dataclass(frozen=True)
class CellChoice:
    """Which cells of a file."""

    file: File
    setting: Setting = "demo"
    folder: Folder = None
    only: Only = ""
    overrides: Overrides = None


_COLOURS = {
    "done": "green",
    "not driven live": "yellow",
    "failed": "red",
    "unreadable": "red",
    "changed": "yellow",
    "running": "cyan",
    "begun": "cyan",
}
_FAILURE_EXIT = 1


def load_cells(choice: CellChoice, executes: bool = True) -> tuple[Campaign, list[Cell]]:
    """The cells of a file, all and those that are wanted; see `load_experiment` for ``executes``."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    from nodes.experiment.plan.cell import select
    from nodes.experiment.run.config import campaign_of, is_campaign, load_campaign

    overrides = choice.overrides or []
    if is_campaign(choice.file):
        campaign = replace(load_campaign(choice.file, choice.folder, tuple(overrides)), executes=executes)
    else:
        from nodes.experiment.steps.attack import cells
        from nodes.experiment.steps.run import load_experiment

        folder = choice.folder or Path("runs") / choice.setting
        experiment = load_experiment(choice.file, choice.setting, overrides, folder, executes)
        campaign = campaign_of(experiment, overrides, cells(experiment))
    _know_methods(campaign)
    return campaign, select(campaign.cells, choice.only)


def _know_methods(campaign: Campaign) -> None:
    from nodes.experiment.engine.run_folder import CELLS
    from nodes.experiment.plan.method_names import know_methods_of

    know_methods_of(campaign.folder / CELLS, {cell.method for cell in campaign.cells})


def _say_code(choice: CellChoice) -> None:
    """Print the code that a run of a file will execute; nothing is executed for it."""
    from nodes.experiment.plan.setting_file import read_setting
    from nodes.experiment.run.config import is_campaign, load_campaign
    from nodes.lab.plugin_tables import say_code
    from nodes.runtime.named_code import with_absolute_code

    file, overrides = choice.file, choice.overrides or []
    if not is_campaign(file):
        say_code(read_setting(file, choice.setting, overrides).data, file.resolve().parent)
        return
    campaign = load_campaign(file, choice.folder, tuple(overrides))
    named: list[Any] = [{"methods": [cell.code for cell in campaign.cells]}]
    for scenario in campaign.scenarios.values():
        inner = (file.parent / scenario.experiment).resolve()
        # Of the methods only those of the campaign are run.
        data = read_setting(inner, scenario.setting, scenario.set).data
        worlds = {key: data[key] for key in ("world", "deploy") if key in data}
        named.append(with_absolute_code(worlds, inner.parent))
    say_code(named, file.resolve().parent)


def experiment(
    choice: CellChoice,
    until: Annotated[
        str | None,
        typer.Option(
            metavar="STAGE",
            help="Stop after this stage: capture, scene, bake, object, policy, retrain or live.",
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Cells at a time, each in a process of its own.",
            show_default="one per core; of an experiment with one seed, one after another in this process",
        ),
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Threads per cell.", show_default="cores shared among the jobs")
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Run cells on the Ray cluster at host:port; auto: the one in RAY_ADDRESS, or one started here.",
        ),
    ] = None,
    device: Device = None,
    retry: Annotated[
        bool, typer.Option("--retry", help="Also run cells that failed, or were not driven live, before.")
    ] = False,
    gate: Annotated[
        bool,
        typer.Option(
            "--gate/--no-gate", help="Leave out cells whose learned scene the fidelity gate refuses."
        ),
    ] = True,
    search_only: Annotated[
        bool,
        typer.Option(
            "--search-only", help="Search and deploy nothing yet, so that transfer can be predicted first."
        ),
    ] = False,
    anew: Annotated[
        bool,
        typer.Option(
            "--anew", help="Make every stage here, also those that are kept in docs/results/reference."
        ),
    ] = False,
    page: Annotated[
        bool,
        typer.Option(
            "--page", help="Serve the running experiment to browsers on this computer, then its report."
        ),
    ] = False,
    page_port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the page; 0 selects a free one.")
    ] = 8091,
) -> None:
    """Run an experiment, from the photographs to the report: every stage and every cell that is not there yet. It may be stopped at any time."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    from advnerf_core.attack.device import use_device
    from nodes.experiment.run.config import is_campaign
    from nodes.experiment.run.run import Options
    from nodes.runtime.errors import ConfigError

    use_device(device)
    many = is_campaign(choice.file)
    _say_code(choice)
    address = "" if cluster in (None, "auto") else str(cluster)
    backend: Literal["local", "ray"] = "local" if cluster is None else "ray"
    here = not many and jobs is None and cluster is None
    options = Options(
        jobs or 0, threads or 0, backend, address, retry, gate, search_only, here, ready=not many
    )
    if not many:
        _run_one(choice, until, options, anew, page_port if page else None)
        return
    if until is not None or anew or page:
        what = "--until" if until is not None else "--anew" if anew else "--page"
        raise ConfigError(f"expected {what} with an experiment file, got it with the campaign {choice.file}")
    _run_many(choice, options)


def _run_one(choice: CellChoice, until: str | None, options: Options, anew: bool, port: int | None) -> None:
    from nodes.experiment.run.whole import run_experiment
    from nodes.experiment.steps.run import load_experiment

    overrides, folder = choice.overrides or [], choice.folder or Path("runs") / choice.setting
    with ends_in_order():
        loaded = load_experiment(choice.file, choice.setting, overrides, folder)
        if options.here and len(loaded.config.attack.seeds) > 1:
            # Searches with one core each are faster than one after another on all: `python -m benchmarks.seeds_together`.
            options = replace(options, here=False)

        def run(record: ProgressRecord | None) -> list[Ended]:
            return run_experiment(loaded, until, options, choice.only, overrides, anew=anew, record=record)

        if port is None:
            ended = run(None)
        else:
            from nodes.experiment_page.page import run_with_page

            ended = run_with_page(loaded, port, run, lambda text: print(text, flush=True))
    _say_wrong(ended)


def _run_many(choice: CellChoice, options: Options) -> None:
    from nodes.experiment.run.run import run_campaign

    campaign, cells = load_cells(choice)
    with ends_in_order():
        ended = run_campaign(campaign, cells, options, lambda text: print(text, flush=True))
    if not options.search_only:
        _show_table(campaign, campaign.cells, _page_folder(campaign))
    _say_wrong(ended)


def _say_wrong(ended: Sequence[Any]) -> None:
    wrong = [end for end in ended if end.how != "done"]
    for end in wrong:
        say_error(f"{end.name}: {end.text}")
    if wrong:
        raise typer.Exit(_FAILURE_EXIT)


def status(
    choice: CellChoice,
) -> None:
    """Say which cells are done, running, failed (and why), made with other settings, or missing."""
    from nodes.experiment.run.plan import statuses

    campaign, cells = load_cells(choice, executes=False)
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


def table_command(
    choice: CellChoice,
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="Show the cells that were published there, e.g. in docs/results, of whatever settings.",
            show_default="those of these settings",
        ),
    ] = None,
) -> None:
    """Print the table of all cells, and the targets."""
    campaign, cells = load_cells(choice, executes=False)
    _show(campaign, cells, None, source)


def report(
    choice: CellChoice,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Folder of the page.", show_default="table in the folder of the cells"
        ),
    ] = None,
    source: Annotated[
        Path | None,
        typer.Option("--from", help="Of the cells that were published there.", show_default="the own cells"),
    ] = None,
) -> None:
    """Write the table as JSON, CSV, Markdown and a page with the films by outcome, and print it."""
    from nodes.runtime.errors import ConfigError

    if choice.only and output is None:
        raise ConfigError(
            "expected --output with --only, as the page of some cells would replace that of all"
        )
    campaign, cells = load_cells(choice, executes=False)
    _show(campaign, cells, output or _page_folder(campaign), source)


def _show(campaign: Campaign, cells: Sequence[Cell], output: Path | None, source: Path | None) -> None:
    if source is None:
        _show_table(campaign, cells, output)
    else:
        _show_published(campaign, cells, output, source / campaign.name)


def _page_folder(campaign: Campaign) -> Path:
    return campaign.folder / "table"


def _show_table(campaign: Campaign, cells: Sequence[Cell], output: Path | None) -> None:
    from nodes.experiment.run.plan import statuses
    from nodes.experiment.run.published import campaign_table

    _know_methods(campaign)  # titles are kept since cells were run
    found = statuses(campaign, cells)
    full = campaign_table(campaign, found)
    page = _write_and_print(campaign, full, campaign.folder, campaign.folder / "cells", output)
    left_out = [each for each in found if each.state in ("changed", "unreadable")]
    for each in left_out:
        say_error(f"{each.cell.name} is left out: {each.text}")
    _say_where(full, cells, page)


def _show_published(campaign: Campaign, cells: Sequence[Cell], output: Path | None, folder: Path) -> None:
    from nodes.experiment.run.published import published_table

    full = published_table(folder, campaign, list(cells))
    # Films are not published; those of the campaign's own cells may be of other drives.
    _say_where(full, cells, _write_and_print(campaign, full, folder, folder, output))


def _write_and_print(
    campaign: Campaign, full: ResultTable, folder: Path, clips_folder: Path, output: Path | None
) -> Path | None:
    """Table, targets and the predictions in ``folder`` to the terminal, and the page into ``output`` if it is asked for."""
    from rich.console import Console

    from advnerf_core.files import write_atomically
    from advnerf_core.report.predictions import prediction_section, prediction_table, skill_text
    from advnerf_core.report.result_page import text_table
    from advnerf_core.report.targets import evaluate, target_table
    from nodes.experiment.pages.table import write_table
    from nodes.experiment.run.predictions import predicted

    pairs = predicted(folder, list(full.cells.values()))
    targets = evaluate(campaign.reference.targets, full)
    page = None
    if output is not None:
        sections = [("Predicted and measured transfer", prediction_section(pairs))] if pairs else []
        page = write_table(full, clips_folder, output, sections, targets=targets)
        if pairs:
            records = [pair.record() for pair in pairs]
            write_atomically(output / "predictions.json", json.dumps(records, indent=1) + "\n")
    console = Console(width=None if sys.stdout.isatty() else 200)
    console.print(text_table(full).rich())
    if targets:
        console.print(target_table(targets).rich())
    if pairs:
        console.print(prediction_table(pairs).rich())
        print(skill_text(pairs))
    return page


def _say_where(full: ResultTable, cells: Sequence[Cell], page: Path | None) -> None:
    print(
        f"{len(full.cells)} of {len(cells)} cells; "
        + (f"page: {page}" if page else "advnerf report writes a page of them")
    )


def predict(
    choice: CellChoice,
    draws: Annotated[int, typer.Option(min=9, help="Drives per prediction.")] = 20,
) -> None:
    """Predict how the attacks transfer from pictures without a deployed drive with them; the table then says how good that was."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    from nodes.experiment.run.predictions import predict_campaign

    campaign, cells = load_cells(choice)
    with ends_in_order():
        made = predict_campaign(campaign, cells, lambda text: print(text, flush=True), draws)
    print(f"{made} predictions made")


def maps(
    choice: CellChoice,
    number: Annotated[int, typer.Option("--object", min=0, help="Which object is moved.")] = 0,
) -> None:
    """Draw the loss landscape and the robustness map (starts x moves of an object) of finished cells that have placed objects."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    from nodes.experiment.run.maps import map_cells

    campaign, cells = load_cells(choice)
    for picture in map_cells(campaign, cells, number):
        print(picture)


def publish(
    choice: CellChoice,
    to: Annotated[Path, typer.Option(help="Gets a folder with the campaign's name.")] = Path("docs/results"),
    prune: Annotated[
        bool, typer.Option("--prune", help="Remove cells there that other settings have made.")
    ] = False,
    build: Annotated[
        bool,
        typer.Option(
            "--build/--no-build", help="Keep the scenes and victims too, some 20 MB for each place."
        ),
    ] = True,
    withdraw: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SCENARIO=REASON",
            help="Give a registered scenario up of which nothing was published; the page says so, and why.",
        ),
    ] = None,
    declare: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SCENARIO.VICTIM=REASON",
            help="Say that a victim breaks the registered rule of what drives well, and why it is shown; the page says so.",
        ),
    ] = None,
) -> None:
    """Copy the finished cells, and the scenes, victims and objects that they were run with, to where they are kept with the code."""
    from advnerf_core.report.evidence import registration
    from advnerf_core.report.evidence.above import write_above_of
    from advnerf_core.report.evidence.publishing import write_numbers, write_page
    from advnerf_core.report.evidence.verifying import victims
    from advnerf_core.report.evidence.verifying.digests import write_beside
    from nodes.experiment.run.plan import statuses
    from nodes.experiment.run.published import publish as copy_cells
    from nodes.experiment.run.published import publish_build
    from nodes.experiment.run.set_film import write_film
    from nodes.experiment.run.store import NOT_DRIVEN
    from nodes.runtime.errors import ConfigError

    campaign, cells = load_cells(choice)
    registered = (to / campaign.name / registration.FILE).exists()
    if registered and not build:
        raise ConfigError(
            f"expected to publish the registered set {campaign.name} with its scene and victim, got --no-build; leave it out: without them nobody "
            "can drive the set again"
        )
    found_here = statuses(campaign, cells)
    for each in found_here:
        if each.state == NOT_DRIVEN:
            say_error(
                f"{each.cell.name} is no evidence and is not published: it was not driven live: {each.text}"
            )
    found = copy_cells(campaign, found_here, to, prune)
    for name in found.written:
        print(f"{to / campaign.name / name}.json")
    if withdraw:
        registration.withdraw(to / campaign.name, dict(_scenario_and_reason(each) for each in withdraw))
    if declare:
        victims.declare(to / campaign.name, dict(_scenario_and_reason(each) for each in declare))
    if build:  # before the page, which says whether the set can be driven again
        _say_build(publish_build(campaign, cells, to, prune))
    if registered:
        print(write_numbers(to / campaign.name))
        if (film := write_film(campaign, to / campaign.name)) is not None:
            print(film)
            print(write_above_of(to / campaign.name))  # with frames of the film
        print(write_page(to))
    else:
        write_beside(to)
    unfinished = len(cells) - len(found.written) - len(found.same)
    print(f"{len(found.written)} cells written, {len(found.same)} were there, {unfinished} are not finished")
    if found.stale:
        what = "were made with other settings and " + (
            "are removed" if prune else "stay, until --prune removes them"
        )
        print(f"{len(found.stale)} of those there {what}: {', '.join(found.stale)}")


def _scenario_and_reason(text: str) -> tuple[str, str]:
    scenario, _, reason = text.partition("=")
    return scenario, reason


def _say_build(build: PublishedBuild) -> None:
    for each in build.written:
        print(each)
    for each in build.removed:
        print(f"{each}: removed, as no published cell was run with it")
    print(f"{build.folder}: {build.size_bytes / 1e6:.1f} MB")


def add_to(app: typer.Typer) -> None:
    """Add the commands."""
    for command in (experiment, status, report, predict, maps, publish):
        app.command()(with_groups(command))
    app.command(name="table")(with_groups(table_command))
