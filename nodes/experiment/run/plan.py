"""Plans the cells to run: each with its current settings, and the possible places of its result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from advnerf_core.report.cells import read_cell
from advnerf_core.report.conditions import NONE
from advnerf_core.report.evidence.registration import (
    FILE,
    RegisteredCell,
    RegisteredScenario,
    Registration,
    launch_file,
    read_registration,
    settings_differences,
)
from nodes.experiment.engine.artefact import PUBLISHED
from nodes.experiment.engine.run_folder import CELLS
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import outdated_stages, runs_alone
from nodes.experiment.run.store import CellStatus, Store
from nodes.experiment.run.worker import Job
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import VictimChangedError
from nodes.experiment.steps.keys import cell_settings, registered_settings, settings_hash
from nodes.runtime.errors import ConfigError, RuntimeFault

# In a message.
_MOST_DIFFERENCES = 5


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
            registration=registered_under(registration, cell, of),
            alone=runs_alone(of),
            control_m=_published_control_m(experiment, cell),
        )
        planned.append(job)
    return planned


def _published_control_m(experiment: Experiment, cell: Cell) -> tuple[float, ...]:
    """Total CTE of each start of the control with which the set's published cells are compared [m]; empty without one that was driven live."""
    of, file = experiment.of(cell), _published_file(experiment, cell.clean)
    if cell.method == NONE or not of.config.deploy.live or not file.exists():
        return ()
    control = read_cell(file)
    same = control.settings_hash == settings_hash(of, cell.inside.clean)
    return control.deployed.total_cte_m if same and control.deployed is not None else ()


def registered_under(registration: Registration | None, cell: Cell, of: Experiment) -> str:
    """Digest of the registration of a cell; empty if it is not registered with the settings, files, code and victim that its variant ``of`` has."""
    if registration is None or registered_cell(cell) not in registration.cells:
        return ""
    scenario = registration.scenarios.get(cell.scenario)
    same = (
        scenario is not None
        and scenario.settings_sha256 == registered_settings(of).key
        and not _pinned_differences(scenario, cell, of)
    )
    return registration.digest if same else ""


def _pinned_differences(scenario: RegisteredScenario, cell: Cell, of: Experiment) -> list[str]:
    """The files, code and victim of a cell that differ from the registered ones."""
    found = cell_settings(of, cell.inside).resolved
    return settings_differences(scenario.pinned(cell.victim, cell.method), found)


def not_registered(experiment: Experiment, cells: Sequence[Cell]) -> str:
    """How many cells will be no evidence, as their file and setting were registered with other values; empty if none."""
    registration = read_registration(PUBLISHED / experiment.config.name)
    there = (experiment.file.name, experiment.setting)
    if registration is None or there != (launch_file(registration.file), registration.setting):
        return ""
    outside = [
        cell
        for cell in cells
        if registered_cell(cell) in registration.cells
        and not registered_under(registration, cell, experiment.of(cell))
    ]
    if not outside:
        return ""
    scenario, of = registration.scenarios.get(outside[0].scenario), experiment.of(outside[0])
    differ = []
    if scenario is not None:
        differ = settings_differences(scenario.settings, registered_settings(of).resolved)
        differ += _pinned_differences(scenario, outside[0], of)
    why = f": {', '.join(differ[:_MOST_DIFFERENCES])}" if differ else ""
    return (
        f"{len(outside)} cells are not run under the registration {PUBLISHED / registration.name / FILE}, and cannot be published in its set, as their "
        f"settings, files, code or victims differ{why}"
    )


def registered_cell(cell: Cell) -> RegisteredCell:
    """The cell in the form of a registration."""
    return RegisteredCell(scenario=cell.scenario, victim=cell.victim, method=cell.method, seed=cell.seed)


def statuses(experiment: Experiment, cells: Sequence[Cell]) -> list[CellStatus]:
    """State of every cell; a cell whose variant cannot be read yet counts as missing."""
    store = Store(experiment.folder)
    found = []
    for cell in cells:
        key, changed = current_key(experiment, cell)
        found.append(store.status(cell, key, elsewhere(experiment, cell), changed))
    return found


def elsewhere(experiment: Experiment, cell: Cell) -> list[Path]:
    """Further files that may have a cell's result: in its variant's run folder, and in the folder of cells stored with the code."""
    own = experiment.folder_of(cell) / CELLS / f"{cell.inside.name}.json"
    kept = _published_file(experiment, cell)
    return [kept] if own == Store(experiment.folder).result_file(cell.name) else [own, kept]


def _published_file(experiment: Experiment, cell: Cell) -> Path:
    """File of a cell's result with the code; it need not exist."""
    return PUBLISHED / experiment.config.name / f"{cell.name}.json"


def current_key(experiment: Experiment, cell: Cell) -> tuple[str | None, str]:
    """Hash of everything that a cell depends on; None while its inputs do not exist, or once they changed, with what changed.

    Raises:
        ConfigError: The cell's variant is wrong.
    """
    try:
        of = experiment.of(cell)
        key = settings_hash(of, cell.inside)
        if outdated := outdated_stages(of, cell.victim):
            return (
                None,
                f"what {', '.join(outdated)} was made from changed; advnerf experiment run makes it anew",
            )
        return key, ""
    except ConfigError:
        raise
    except VictimChangedError:
        return None, "its victim changed since it was last looked at; advnerf experiment run looks again"
    except (RuntimeFault, OSError):
        return None, ""
