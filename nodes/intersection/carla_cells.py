"""The same cells where they are deployed in CARLA: searches run side by side, the one server is driven by one at a time."""

from __future__ import annotations

from typing import Any

from nodes.campaign.kinds import stage_digests
from nodes.intersection.cells import PREPARED_AT, TAKEN_FROM, run_cell, search_cell
from nodes.intersection.context import Experiment

LIVE = True


def cell_inputs(experiment: Experiment, scenario: str, victim: str, method: str, seed: int) -> dict[str, Any]:
    """What a cell depends on: not the server's address, and not which other seeds there are."""
    config = experiment.config.model_dump(mode="json", exclude={"world": True, "attack": {"seeds"}})
    return {"config": config, "world": experiment.site.settings, "stages": stage_digests(experiment.folder)}


__all__ = ["LIVE", "PREPARED_AT", "TAKEN_FROM", "cell_inputs", "run_cell", "search_cell"]
