"""The command ``advnerf demo``: the whole experiment in its small setting."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def add_to(app: typer.Typer) -> None:
    """Register the command."""
    app.command()(demo)


def demo(
    folder: Annotated[Path, typer.Option("--folder", help="Folder of all results.")] = Path("runs/demo"),
    page: Annotated[
        bool, typer.Option("--page", help="Serve it to browsers on this computer while it runs.")
    ] = False,
) -> None:
    """Run the whole experiment in its small setting on the simulated lab, from the photographs to the report (six to twelve minutes on 2 cores)."""
    from nodes.cli.cell_choice import CellChoice
    from nodes.cli.experiment import experiment
    from nodes.runtime.paths import shipped

    experiment(CellChoice(shipped("launch/room.experiment.yaml"), "demo", folder), anew=True, page=page)
