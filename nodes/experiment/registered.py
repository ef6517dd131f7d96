"""Whether a cell is run under a registration: it was registered, with the settings of now."""

from __future__ import annotations

from pathlib import Path

from advnerf_core.report.evidence.registration import RegisteredCell, read_registration
from nodes.experiment.cell import Cell
from nodes.experiment.context import Experiment
from nodes.experiment.keys import registered_settings
from nodes.experiment.stage_record import hash_of


def registered_under(name: str, cell: Cell, experiment: object, published: Path) -> str:
    """Digest of the registration that a cell is run under; empty if it, with the settings of now, is not registered.

    Args:
        name: Of the campaign or experiment.
        cell: Which, as the campaign names it.
        experiment: What the kind of the cell has read; only experiment files can be registered.
        published: Folder of all published sets.
    """
    registration = read_registration(published / name)
    if (
        registration is None
        or not isinstance(experiment, Experiment)
        or registered_cell(cell) not in registration.cells
    ):
        return ""
    scenario = registration.scenario(cell.scenario, cell.placement)
    same = scenario is not None and scenario.settings_sha256 == hash_of(registered_settings(experiment))
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
