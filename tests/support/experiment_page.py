"""A run folder as an experiment leaves it, made quickly: the record, a finished search, a running one, films and a report."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import torch

from advnerf_core.attack.adjoint import Totals
from advnerf_core.attack.search.search import SearchState
from nodes.experiment.engine.progress_record import ProgressRecord
from nodes.experiment.plan.cell import Cell
from tests.support.live.page_client import request

CELLS = [Cell("track", "hardened", method, 0) for method in ("none", "random", "gradient")]
ABOUT = {"name": "room", "setting": "demo", "planned": 5, "space": "colours"}


def record_of(folder: Path) -> ProgressRecord:
    """The record of an experiment that has just begun."""
    record = ProgressRecord(folder, ABOUT)
    record.plan(["capture", "scene", "report"], CELLS)
    return record


def search_so_far(
    folder: Path, totals_m: list[float], seed: int = 0, values: list[float] | None = None
) -> None:
    """The state file of a running search, as `advnerf_core.attack.search` writes it; for ``cte`` values are totals."""
    state = SearchState({})
    for total_m, value in zip(totals_m, values or totals_m, strict=True):
        theta = torch.from_numpy(np.random.default_rng(seed).normal(size=(8, 8, 3)).astype(np.float32))
        state.record(
            theta, -value, Totals(*map(torch.tensor, ([total_m], [total_m], [-value], [value]))), 0.1
        )
    folder.mkdir(parents=True, exist_ok=True)
    state.save(folder / "state.safetensors", "a fingerprint")


def state_of(port: int) -> dict[str, object]:
    """The state, not older than this call."""
    time.sleep(0.6)
    return dict(json.loads(request(port, "/state.json")[2]))
