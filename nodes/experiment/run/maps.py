"""Pictures of the results of finished cells with a space of places."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.plan import current_key
from nodes.experiment.run.store import Store
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.pose_maps import draw_maps, is_mapped
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay


def map_cells(experiment: Experiment, cells: Sequence[Cell], number: int | None = None) -> list[Path]:
    """Draw the maps of all finished cells; existing ones are read from their files. Without a number the experiment says which object is moved.

    Raises:
        ConfigError: No cell is finished, or none has placed objects.
    """
    store, pictures = Store(experiment.folder), []
    for cell in cells:
        inside = experiment.of(cell)
        status = store.status(cell, current_key(experiment, cell)[0])
        wanted = inside.config.maps.object if number is None else number
        if status.state != "done" or status.result is None or not is_mapped(inside, cell.inside, wanted):
            continue
        with ProgressDisplay() as display:
            pictures += draw_maps(
                inside, cell.inside, wanted, store.work(cell.name), display.start(cell.name)
            )
    if not pictures:
        raise ConfigError(
            f"expected finished cells that have placed objects (space.kind=places), got none of {len(cells)}; run them first, "
            "see advnerf experiment status"
        )
    return pictures
