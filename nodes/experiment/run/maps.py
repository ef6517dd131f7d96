"""Pictures about what finished cells found of a space of places."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import draw_maps
from nodes.experiment.run.config import Campaign
from nodes.experiment.run.plan import plan_cells
from nodes.experiment.run.store import store_of
from nodes.experiment.show.context import Experiment
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay


def map_cells(campaign: Campaign, cells: Sequence[Cell], number: int) -> list[Path]:
    """Draw the maps of all cells that are finished; those that are drawn already are read from their files.

    Args:
        campaign: The campaign.
        cells: Which of its cells.
        number: Of the object that is moved.

    Raises:
        ConfigError: No cell is finished, or none has placed objects.
    """
    store, pictures = store_of(campaign), []
    experiments: dict[tuple[str, str], Experiment] = {}
    for cell in cells:
        (planned,) = plan_cells(campaign, [cell], experiments)
        status = store.status(cell, planned.job.settings_hash)
        if status.state != "done" or status.result is None:
            continue
        with ProgressDisplay() as display:
            report = display.start(cell.name)
            pictures += draw_maps(
                experiments[cell.scenario, cell.placement],
                campaign.inside(cell),
                number,
                store.work(cell.name),
                report,
            )
    if not pictures:
        raise ConfigError(
            f"expected finished cells that have placed objects (space.kind=places), got none of {len(cells)}; run them first, "
            "see advnerf status"
        )
    return pictures
