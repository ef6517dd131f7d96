"""The command ``advnerf experiment``, which runs cells, and those that look at finished searches: ``predict`` and ``maps``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from nodes.cli.cell_choice import CellChoice, load_cells
from nodes.cli.cell_tables import page_folder, report, show_table, status, table_command
from nodes.cli.publish import publish
from nodes.runtime.options import with_groups
from nodes.runtime.terminal import Device, say_error
from nodes.runtime.termination import ends_in_order

if TYPE_CHECKING:
    from nodes.experiment.engine.progress_record import ProgressRecord
    from nodes.experiment.run.run import Options
    from nodes.experiment.run.worker import Ended

_FAILURE_EXIT = 1


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
        show_table(campaign, campaign.cells, page_folder(campaign))
    _say_wrong(ended)


def _say_wrong(ended: Sequence[Any]) -> None:
    wrong = [end for end in ended if end.how != "done"]
    for end in wrong:
        say_error(f"{end.name}: {end.text}")
    if wrong:
        raise typer.Exit(_FAILURE_EXIT)


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


def add_to(app: typer.Typer) -> None:
    """Add the commands."""
    for command in (experiment, status, report, predict, maps, publish):
        app.command()(with_groups(command))
    app.command(name="table")(with_groups(table_command))
