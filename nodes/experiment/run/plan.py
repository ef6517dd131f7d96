"""Plans the cells to run: each with its current settings, and the possible places of its result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from advnerf_core.report.evidence.registration import RegisteredCell, Registration, read_registration
from nodes.experiment.engine.artefact import PUBLISHED, Settings
from nodes.experiment.engine.run_folder import CELLS
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import runs_alone
from nodes.experiment.run.store import CellStatus, Store
from nodes.experiment.run.worker import Job
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.keys import registered_settings, settings_hash
from nodes.runtime.errors import ConfigError, RuntimeFault


def plan_cells(experiment: Experiment, cells: Sequence[Cell]) -> list[Job]:
    """A job for every cell, with its current settings; reads variants and digests of their stages, and runs nothing."""
    registration = read_registration(PUBLISHED / experiment.config.name)
    planned = []
    for cell in cells:
        of = experiment.of(cell)
        job = Job(
            str(experiment.folder),
            str(experiment.file),
            experiment.setting,
            experiment.overrides,
            cell,
            settings_hash(of, cell.inside),
            threads=1,
            registration=registered_under(registration, cell, registered_settings(of)),
            alone=runs_alone(of),
        )
        planned.append(job)
    return planned


def registered_under(registration: Registration | None, cell: Cell, settings: Settings) -> str:
    """Digest of the registration of a cell; empty if it is not registered with these settings, its variant's `registered_settings`."""
    if registration is None or registered_cell(cell) not in registration.cells:
        return ""
    scenario = registration.scenario(cell.scenario)
    same = scenario is not None and scenario.settings_sha256 == settings.key
    return registration.digest if same else ""


def registered_cell(cell: Cell) -> RegisteredCell:
    """The cell in the form of a registration."""
    return RegisteredCell(scenario=cell.scenario, victim=cell.victim, method=cell.method, seed=cell.seed)


def statuses(experiment: Experiment, cells: Sequence[Cell]) -> list[CellStatus]:
    """State of every cell; a cell whose variant cannot be read yet counts as missing."""
    store = Store(experiment.folder)
    return [store.status(cell, current_key(experiment, cell), elsewhere(experiment, cell)) for cell in cells]


def elsewhere(experiment: Experiment, cell: Cell) -> list[Path]:
    """Further files that may have a cell's result: in its variant's run folder, and in the folder of cells stored with the code."""
    own = experiment.folder_of(cell) / CELLS / f"{cell.inside.name}.json"
    kept = PUBLISHED / experiment.config.name / f"{cell.name}.json"
    return [kept] if own == Store(experiment.folder).result_file(cell.name) else [own, kept]


def current_key(experiment: Experiment, cell: Cell) -> str | None:
    """Hash of everything that a cell depends on; None if it is unknown yet, because the cell's inputs do not exist.

    Raises:
        ConfigError: The cell's variant is wrong.
    """
    try:
        return plan_cells(experiment, [cell])[0].settings_hash
    except ConfigError:
        raise
    except (RuntimeFault, OSError):
        return None
