"""Pictures about what finished cells found, where their kind can draw some."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.config import Campaign
from nodes.experiment.run.kinds import load_kind
from nodes.experiment.run.plan import plan_cells
from nodes.experiment.run.store import store_of
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay


def map_cells(campaign: Campaign, cells: Sequence[Cell], number: int) -> list[Path]:
    """Draw the maps of all cells that are finished; those that are drawn already are read from their files.

    Args:
        campaign: The campaign.
        cells: Which of its cells.
        number: Of the object that is moved.

    Raises:
        ConfigError: No cell is finished, or none is of a kind that has maps.
    """
    store, pictures = store_of(campaign), []
    experiments: dict[tuple[str, str], Any] = {}
    for cell in cells:
        (planned,) = plan_cells(campaign, [cell], experiments)
        status = store.status(cell, planned.job.settings_hash)
        if status.state != "done" or status.result is None:
            continue
        kind, experiment = load_kind(planned.job.kind), experiments[cell.scenario, cell.placement]
        with ProgressDisplay() as display:
            report = display.start(cell.name)
            pictures += kind.draw_maps(
                experiment, campaign.inside(cell), number, store.work(cell.name), report
            )
    if not pictures:
        raise ConfigError(
            f"expected finished cells that have placed objects (space.kind=places), got none of {len(cells)}; run them first, "
            "see advnerf status"
        )
    return pictures
