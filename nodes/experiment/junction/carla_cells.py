"""The same cells where they are deployed in CARLA: searches run side by side, the one server is driven by one at a time."""

from __future__ import annotations

from nodes.experiment.junction.cells import PREPARED_AT, TAKEN_FROM, cell_inputs, run_cell, search_cell

LIVE = True

__all__ = ["LIVE", "PREPARED_AT", "TAKEN_FROM", "cell_inputs", "run_cell", "search_cell"]
