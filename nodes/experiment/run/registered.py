"""Whether a cell is run under a registration: it was registered, with the settings of now."""

from __future__ import annotations

from typing import Any

from advnerf_core.report.evidence.registration import RegisteredCell, Registration
from nodes.experiment.engine.stage_record import hash_of
from nodes.experiment.plan.cell import Cell


def registered_under(registration: Registration | None, cell: Cell, settings: dict[str, Any]) -> str:
    """Digest of the registration that a cell is run under; empty if it, with these settings, is not registered.

    Args:
        registration: Of the campaign or experiment; None if there is none.
        cell: Which, as the campaign names it.
        settings: What `registered_settings` says of its experiment.
    """
    if registration is None or registered_cell(cell) not in registration.cells:
        return ""
    scenario = registration.scenario(cell.scenario, cell.placement)
    same = scenario is not None and scenario.settings_sha256 == hash_of(settings)
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
