"""The command ``advnerf demo``: the whole experiment in its small setting."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from nodes.experiment.engine.progress_record import ProgressRecord
    from nodes.experiment.run.worker import Ended

_PORT = 8091


def demo(
    folder: Annotated[Path, typer.Option("--folder", help="Folder of all results.")] = Path("runs/demo"),
    page: Annotated[
        bool,
        typer.Option(
            "--page/--no-page", help="Serve it to browsers on this computer while it runs, and open one."
        ),
    ] = True,
    recorded: Annotated[
        bool,
        typer.Option(
            "--recorded/--no-recorded",
            help="Show the drive of a recorded victim first, until this run has drives of its own.",
        ),
    ] = True,
) -> None:
    """Run the whole experiment in its small setting on the simulated lab, from the photographs to the report (four to twelve minutes on 2 cores)."""
    from nodes.lab.recorded_victim import FirstPicture
    from nodes.runtime.termination import ends_in_order

    # It is on its way while this process imports what searches need.
    with ends_in_order(), FirstPicture(folder, _say) if recorded else nullcontext():
        _run(folder, _page_port() if page else None)


def _run(folder: Path, port: int | None) -> None:
    from nodes.cli.cell_choice import CellChoice, load_cells
    from nodes.cli.experiment import say_wrong
    from nodes.experiment.pages.setting import setting_lines
    from nodes.experiment.run.run import Options
    from nodes.experiment.run.whole import run_experiment
    from nodes.experiment_page.page import run_with_page, user_browser
    from nodes.runtime.paths import shipped

    loaded, _ = load_cells(CellChoice(shipped("launch/room.experiment.yaml"), "demo", folder))

    def run(record: ProgressRecord | None) -> list[Ended]:
        ended = run_experiment(loaded, None, Options(here=True, ready=True), anew=True, record=record)
        for line in setting_lines(loaded):
            _say(line)
        return ended

    if port is None:
        ended = run(None)
    else:
        # Only somebody whom a browser shows the page is kept from the prompt by it.
        stays = sys.stdout.isatty() and user_browser() is not None
        ended = run_with_page(loaded, port, run, _say, opens=True, stays=stays)
    say_wrong(ended)


def _page_port() -> int | None:
    """The usual port of the page, or any free one; None, with a message, if its packages are not installed."""
    from nodes.experiment_page.server import HOST, PACKAGES
    from nodes.operator_page.listening import bound_socket, require_packages
    from nodes.runtime.errors import BusError, ConfigError

    try:
        require_packages(PACKAGES)
        bound_socket(HOST, _PORT).close()
    except BusError:
        return 0
    except ConfigError as error:
        _say(f"without a page: {error}")
        return None
    return _PORT


def _say(text: str) -> None:
    print(text, flush=True)
