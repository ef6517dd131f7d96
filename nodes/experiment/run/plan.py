"""What there is to run: every cell with its settings as they are, and where its result may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from advnerf_core.report.evidence.registration import RegisteredCell, Registration, read_registration
from nodes.experiment.engine.artefact import PUBLISHED, Settings
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import runs_alone
from nodes.experiment.run.config import Campaign
from nodes.experiment.run.store import CellStatus, store_of
from nodes.experiment.run.worker import Job
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.keys import registered_settings, settings_hash
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError, RuntimeFault


@dataclass(frozen=True)
class Planned:
    """A cell with its settings, as they are now.

    Attributes:
        cell: Which.
        job: How it is run; without threads and phase.
        live: Whether it drives a live graph.
    """

    cell: Cell
    job: Job
    live: bool


def plan_cells(
    campaign: Campaign, cells: Sequence[Cell], experiments: dict[tuple[str, str], Experiment] | None = None
) -> list[Planned]:
    """Settings of every cell as they are; reads experiments and digests of their stages, prepares nothing.

    Args:
        campaign: The campaign.
        cells: Which of its cells.
        experiments: Those that were read already, by scenario and placement; it gets what is read.
    """
    experiments = {} if experiments is None else experiments
    registration = read_registration(PUBLISHED / campaign.name)
    planned = []
    for cell in cells:
        key = (cell.scenario, cell.placement)
        if key not in experiments:
            experiments[key] = read_experiment(campaign, cell)
        inside = campaign.inside(cell)
        digest = settings_hash(experiments[key], inside)
        job = Job(
            str(campaign.folder),
            cell.name,
            str(campaign.experiment_file(cell)),
            campaign.scenario(cell).setting,
            tuple(campaign.overrides(cell)),
            str(campaign.run_folder(cell)),
            inside.scenario,
            cell.scenario,
            cell.placement,
            cell.victim,
            cell.code,
            cell.seed,
            digest,
            threads=1,
            registration=registered_under(registration, cell, registered_settings(experiments[key])),
        )
        planned.append(Planned(cell, job, runs_alone(experiments[key])))
    return planned


def registered_under(registration: Registration | None, cell: Cell, settings: Settings) -> str:
    """Digest of the registration that a cell is run under; empty if it, with these settings, is not registered.

    Args:
        registration: Of the campaign or experiment; None if there is none.
        cell: Which, as the campaign names it.
        settings: What `registered_settings` says of its experiment.
    """
    if registration is None or registered_cell(cell) not in registration.cells:
        return ""
    scenario = registration.scenario(cell.scenario, cell.placement)
    same = scenario is not None and scenario.settings_sha256 == settings.key
    return registration.digest if same else ""


def registered_cell(cell: Cell) -> RegisteredCell:
    """The cell as a registration names it."""
    return RegisteredCell(
        scenario=cell.scenario,
        placement=cell.placement,
        victim=cell.victim,
        method=cell.method,
        seed=cell.seed,
    )


def statuses(campaign: Campaign, cells: Sequence[Cell]) -> list[CellStatus]:
    """Where every cell is; one whose experiment cannot be read, as it is not made yet, is missing."""
    store = store_of(campaign)
    experiments: dict[tuple[str, str], Experiment] = {}
    return [
        store.status(cell, hash_as_it_is(campaign, cell, experiments), elsewhere(campaign, cell))
        for cell in cells
    ]


def elsewhere(campaign: Campaign, cell: Cell) -> list[Path]:
    """Files where a cell may be besides the campaign's own folder: in the run folder of its experiment, and where cells are kept with the code."""
    run = campaign.run_folder(cell)
    return [
        *([run / "cells" / f"{campaign.inside(cell).name}.json"] if run != campaign.folder else []),
        PUBLISHED / campaign.name / f"{cell.name}.json",
    ]


def hash_as_it_is(
    campaign: Campaign, cell: Cell, experiments: dict[tuple[str, str], Experiment]
) -> str | None:
    """Hash of everything that a cell depends on; None if it cannot be known yet, as what the cell needs is not made.

    Args:
        campaign: The campaign.
        cell: Which of its cells.
        experiments: As of `plan_cells`.

    Raises:
        ConfigError: Its experiment is wrong.
    """
    try:
        return plan_cells(campaign, [cell], experiments)[0].job.settings_hash
    except ConfigError:
        raise
    except (RuntimeFault, OSError):
        return None


def read_experiment(campaign: Campaign, cell: Cell) -> Experiment:
    """Read the experiment of a cell, with the campaign's settings."""
    return load_experiment(
        campaign.experiment_file(cell),
        campaign.scenario(cell).setting,
        campaign.overrides(cell),
        campaign.run_folder(cell),
        campaign.executes,
    )
