"""Which cells a command is about: a file, its setting and run folder, and a choice of its cells."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.runtime.terminal import Overrides, experiment_argument

if TYPE_CHECKING:
    from nodes.experiment.plan.cell import Cell
    from nodes.experiment.run.config import Campaign

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
    know_methods(campaign)
    return campaign, select(campaign.cells, choice.only)


def know_methods(campaign: Campaign) -> None:
    """Give the methods of a campaign colours, and the titles that are kept beside its cells."""
    from nodes.experiment.engine.run_folder import CELLS
    from nodes.experiment.plan.method_names import know_methods_of

    know_methods_of(campaign.folder / CELLS, {cell.method for cell in campaign.cells})
