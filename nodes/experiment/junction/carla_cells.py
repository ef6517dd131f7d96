"""The same cells where they are deployed in CARLA: searches run side by side, the one server is driven by one at a time."""

from __future__ import annotations

from nodes.experiment.junction.cells import (
    TAKEN_FROM,
    cell_inputs,
    has_learned_scene,
    predictable,
    prepare,
    run_cell,
    search_cell,
)

LIVE = True

__all__ = [
    "LIVE",
    "TAKEN_FROM",
    "cell_inputs",
    "has_learned_scene",
    "predictable",
    "prepare",
    "run_cell",
    "search_cell",
]
