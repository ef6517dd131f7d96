"""The command ``advnerf experiment run``, which runs cells, and those that look at finished searches: ``predict`` and ``maps``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from nodes.cli.cell_choice import CellChoice, load_cells
from nodes.cli.cell_tables import page_folder, report, show_table, status, table_command
from nodes.cli.init import init
from nodes.cli.lists import list_command
from nodes.cli.panels import in_panels
from nodes.cli.publish import publish
from nodes.cli.register import register
from nodes.runtime.errors import ConfigError
from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import Device, fail_unless, say_error
from nodes.runtime.termination import ends_in_order

if TYPE_CHECKING:
    from nodes.experiment.engine.progress_record import ProgressRecord
    from nodes.experiment.plan.cell import Cell
    from nodes.experiment.run.run import Options
    from nodes.experiment.run.worker import Ended
    from nodes.experiment.show.context import Experiment

app = CommandGroup(
    no_args_is_help=True,
    cls=in_panels(
        {
            "Run": ("run", "status", "table", "report"),
            "Look closer": ("predict", "maps"),
            "Publish": ("register", "publish"),
            "Write experiments": ("init", "list"),
        }
    ),
    help="Run an experiment from the photographs to the report, look at its results, and publish them.",
)
_MANY = 1000


def _say_code(choice: CellChoice) -> None:
    """Print the code that a run of a file will execute; nothing is executed for it."""
    from advnerf_core.run_module import search_folder_last
    from nodes.experiment.plan.experiment_file import read_experiment_file
    from nodes.lab.plugin_tables import say_code

    read = read_experiment_file(choice.file, choice.setting, choice.overrides or [])
    documents = [*read.variants.values()] or [read.document]
    folder = choice.file.resolve().parent
    search_folder_last(str(folder))  # as loading the experiment does
    say_code([each.data for each in documents], folder)


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
    many: Annotated[
        bool, typer.Option("--many", help=f"Run more than {_MANY} cells without being asked.")
    ] = False,
) -> None:
    """Run an experiment, from the photographs to the report: every stage and every cell that is not there yet. It may be stopped at any time."""
    from advnerf_core.attack.device import use_device
    from nodes.experiment.run.run import Options

    use_device(device)
    _say_code(choice)
    address = "" if cluster in (None, "auto") else str(cluster)
    backend: Literal["local", "ray"] = "local" if cluster is None else "ray"
    loaded, cells = load_cells(choice)
    if until is None:
        _allow(len(cells), many)
    options = Options(jobs or 0, threads or 0, backend, address, retry, gate, search_only)
    with ends_in_order():
        if not loaded.variants:
            # Searches with one core each are faster than one after another on all: `python -m benchmarks.seeds_together`.
            here = jobs is None and cluster is None and len(loaded.config.seeds) == 1
            ended = _run_one(
                loaded,
                choice.only,
                until,
                replace(options, here=here, ready=True),
                anew,
                page_port if page else None,
            )
        else:
            if page or (anew and until is None):
                loaded.require_one()
            ended = _run_variants(loaded, cells, until, options, anew)
    say_wrong(ended)


def _allow(count: int, many: bool) -> None:
    """Ask before more cells are run than a person may have meant."""
    if count <= _MANY or many:
        return
    if not sys.stdin.isatty():
        raise ConfigError(
            f"expected at most {_MANY} cells without --many, got {count}; add it, or run some with --only"
        )
    typer.confirm(f"Run {count} cells?", abort=True)


def _run_one(
    loaded: Experiment, only: str, until: str | None, options: Options, anew: bool, port: int | None
) -> list[Ended]:
    from nodes.experiment.run.whole import run_experiment

    def run(record: ProgressRecord | None) -> list[Ended]:
        return run_experiment(loaded, until, options, only, anew=anew, record=record)

    if port is None:
        return run(None)
    from nodes.experiment_page.page import run_with_page

    return run_with_page(loaded, port, run, lambda text: print(text, flush=True))


def _run_variants(
    loaded: Experiment, cells: Sequence[Cell], until: str | None, options: Options, anew: bool
) -> list[Ended]:
    from nodes.experiment.run.run import run_cells

    def say(text: str) -> None:
        print(text, flush=True)

    if until is not None:
        from nodes.experiment.run.whole import run_stages_of_variants

        run_stages_of_variants(loaded, cells, until, say, anew)
        return []
    ended = run_cells(loaded, cells, options, say)
    if not options.search_only:
        show_table(loaded, loaded.cells, page_folder(loaded))
    return ended


def say_wrong(ended: Sequence[Any]) -> None:
    """Print the cells that did not end well, and exit with an error if there are any."""
    wrong = [end for end in ended if end.how != "done"]
    for end in wrong:
        say_error(f"{end.name}: {end.text}")
    fail_unless(not wrong)


def predict(
    choice: CellChoice,
    draws: Annotated[int, typer.Option(min=9, help="Drives per prediction.")] = 20,
) -> None:
    """Predict how the attacks transfer from pictures without a deployed drive with them; the table then says how good that was."""
    from nodes.experiment.run.predictions import predict_cells

    experiment, cells = load_cells(choice)
    with ends_in_order():
        made = predict_cells(experiment, cells, lambda text: print(text, flush=True), draws)
    print(f"{made} predictions made")


def maps(
    choice: CellChoice,
    number: Annotated[
        int | None,
        typer.Option("--object", min=0, help="Which object is moved.", show_default="maps.object"),
    ] = None,
) -> None:
    """Draw the loss landscape and the robustness map (starts x moves of an object) of finished cells that have placed objects."""
    from nodes.experiment.run.maps import map_cells

    experiment, cells = load_cells(choice)
    for picture in map_cells(experiment, cells, number):
        print(picture)


app.command("run")(experiment)
for command in (status, report, predict, maps, register, publish):
    app.command()(command)
app.command("table")(table_command)
app.command("init")(init)
app.command("list")(list_command)
