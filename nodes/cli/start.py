"""The commands of a first day with an installed package: the demo, and files to edit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def add_to(app: typer.Typer) -> None:
    """Register both commands."""
    app.command()(demo)
    app.command()(init)


def demo(
    folder: Annotated[Path, typer.Option("--run-folder", help="Folder of all results.")] = Path("runs/demo"),
    page: Annotated[
        bool, typer.Option("--page", help="Serve it to browsers on this computer while it runs.")
    ] = False,
) -> None:
    """Run the whole experiment in its small setting on the simulated lab, from the photographs to the report (six to twelve minutes on 2 cores)."""
    from nodes.cli.cell_choice import CellChoice
    from nodes.cli.experiment import experiment
    from nodes.runtime.paths import shipped

    experiment(CellChoice(shipped("launch/room.experiment.yaml"), "demo", folder), anew=True, page=page)


def init(
    folder: Annotated[Path, typer.Argument(help="Folder to work in.", file_okay=False)],
) -> None:
    """Copy launch and experiment files, the examples and the simulated lab's calibration into a folder, to edit. Existing files are kept."""
    from advnerf_core.files import write_atomically
    from nodes.runtime.paths import shipped

    copied = kept = 0
    for name in ("launch", "examples", "calibration/twin"):
        source = shipped(name)
        for file in sorted(path for path in source.rglob("*") if path.is_file() and path.suffix != ".pyc"):
            target = folder / name / file.relative_to(source)
            if target.exists():
                kept += 1
            else:
                write_atomically(target, file.read_bytes())
                copied += 1
    stay = f", {kept} were there and stay as they are" if kept else ""
    print(
        f"{copied} files copied to {folder}{stay}; work in that folder, as in: cd {folder}; advnerf launch green_screen --check"
    )
