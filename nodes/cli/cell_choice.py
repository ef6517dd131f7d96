"""Which cells a command is about: a file, its setting and run folder, and a choice of its cells."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.runtime.terminal import Overrides, experiment_argument

if TYPE_CHECKING:
    from nodes.experiment.plan.cell import Cell
    from nodes.experiment.show.context import Experiment

File = Annotated[
    Path,
    typer.Argument(
        metavar="FILE|NAME",
        help="A *.experiment.yaml file, or the name of one.",
        parser=experiment_argument,
    ),
]
Setting = Annotated[
    str | None,
    typer.Option(
        "--setting",
        help="Which of the experiment file's settings.",
        show_default="demo, if the file has settings",
    ),
]
Folder = Annotated[
    Path | None,
    typer.Option(
        "--folder",
        help="Folder of all results.",
        show_default="run_folder of the file, or runs/<setting>",
    ),
]
Only = Annotated[
    list[str] | None,
    typer.Option(
        "--only",
        metavar="KEY=VALUE,...",
        help="Only these cells, e.g. path=straight+left,method=gradient. May be repeated.",
    ),
]


@dataclass(frozen=True)
class CellChoice:
    """Which cells of a file."""

    file: File
    setting: Setting = None
    folder: Folder = None
    parts: Only = None
    overrides: Overrides = None

    @property
    def only(self) -> str:
        """The selection of cells as `select` reads it."""
        return ",".join(self.parts or [])


def load_cells(choice: CellChoice, executes: bool = True) -> tuple[Experiment, list[Cell]]:
    """An experiment and its requested cells; see `load_experiment` for ``executes``."""
    from nodes.experiment.plan.cell import select
    from nodes.experiment.steps.run import load_experiment

    experiment = load_experiment(choice.file, choice.setting, choice.overrides or [], choice.folder, executes)
    know_methods(experiment)
    return experiment, select(experiment.cells, choice.only)


def know_methods(experiment: Experiment) -> None:
    """Give the methods of an experiment colours, and the titles that are kept beside its cells."""
    from nodes.experiment.engine.run_folder import CELLS
    from nodes.experiment.plan.method_names import know_methods_of

    know_methods_of(experiment.folder / CELLS, {cell.method for cell in experiment.cells})
