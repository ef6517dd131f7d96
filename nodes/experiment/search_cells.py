"""Cells of a campaign on the learned room alone, kind ``room_search``: nothing is deployed, so all of them run beside one another.

For studies of many attacks, of which only some are deployed afterwards: those by a campaign of kind ``room``.
"""

from __future__ import annotations

from nodes.experiment.cells import cell_inputs, load_experiment, prepare
from nodes.experiment.cells import searched_part as run_cell

__all__ = ["cell_inputs", "load_experiment", "prepare", "run_cell"]
