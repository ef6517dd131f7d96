"""Predicted against measured transfer: one prediction per attacked cell, made without its deployed drives, and how good they were."""

# ruff: noqa: RUF001 (typography for readers: multiplication signs)

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from advnerf_core.report.cells import CellResult
from advnerf_core.report.conditions import CONTROLS
from advnerf_core.report.transfer_prediction import Predicted
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import is_predictable
from nodes.experiment.run.config import Campaign
from nodes.experiment.run.plan import plan_cells
from nodes.experiment.run.store import store_of
from nodes.experiment.show.context import Experiment

if TYPE_CHECKING:
    from nodes.experiment.run.gate import CleanDrive

_KEYS = {"ratio", "ratio_low", "ratio_high", "retained", "total_cte_m", "clean_drive"}


def predict_campaign(
    campaign: Campaign, cells: Sequence[Cell], say: Callable[[str], None], draws: int | None = None
) -> int:
    """Predict every attacked cell that has been searched and is not predicted yet; returns how many were.

    A prediction needs the finished search (``advnerf experiment --search-only`` makes no more than that) and the drive without attack. It reads
    no drive with the attack, so it is the same before and after that drive.

    Args:
        campaign: The campaign.
        cells: Of it.
        say: Told what was predicted, and what was not and why.
        draws: Drives per prediction, `DEFAULT_DRAWS` unless told.
    """
    from nodes.experiment.run.gate import DEFAULT_DRAWS, lacks, predict_cell  # loads torch

    draws = DEFAULT_DRAWS if draws is None else draws
    store, made = store_of(campaign), 0
    experiments: dict[tuple[str, str], Experiment] = {}
    clean: dict[tuple[str, str, str, int], CleanDrive] = {}
    for cell in cells:
        if not cell.searched:
            continue
        planned = plan_cells(campaign, [cell], experiments)[0]
        # Work of other settings may hold a search too, of another attack.
        experiment = experiments[cell.scenario, cell.placement]
        if not is_predictable(experiment):
            continue
        file = prediction_file(campaign.folder, cell.name)
        kept = kept_prediction(file, planned.job.settings_hash)
        if kept is not None and kept.get("draws") == draws:
            continue
        if not store.has_begun(cell.name, planned.job.settings_hash):
            if kept is not None or store.result(cell.name) is not None:
                say(f"{cell.name}: not predicted, as its search is not in {store.work(cell.name)}")
            continue
        which = (experiment, campaign.inside(cell), store.work(cell.name))
        if lacking := lacks(*which):
            say(f"{cell.name}: not predicted, as it lacks {lacking}")
            continue
        drive = (cell.scenario, cell.placement, cell.victim, cell.seed)
        found, clean[drive] = predict_cell(*which, draws, clean.get(drive))
        summary = clean[drive].agreement.summary()
        record = {"settings_hash": planned.job.settings_hash, **found.record(), "clean_drive": summary}
        write_atomically(file, json.dumps(record, indent=1) + "\n")
        say(
            f"{cell.name}: {found.ratio:.2f} × no attack expected, {100 * found.retained:.0f} % of the effect survives"
        )
        made += 1
    return made


def predicted(folder: Path, results: Sequence[CellResult]) -> list[Predicted]:
    """Predictions of finished cells, each with what was measured.

    Args:
        folder: Of the campaign, or of what was published of it.
        results: Its finished cells.
    """
    pairs = []
    for cell in results:
        if cell.deployed is None or cell.method in CONTROLS:
            continue
        kept = kept_prediction(prediction_file(folder, cell.name), cell.settings_hash)
        if kept is None:
            continue
        none_m = sum(cell.deployed.none_total_cte_m)
        measured = sum(cell.deployed.total_cte_m) / none_m if none_m > 0.0 else math.nan
        starts = cell.shared_starts
        learned, learned_none = (
            sum(each[:starts]) for each in (cell.surrogate.total_cte_m, cell.surrogate.none_total_cte_m)
        )
        pairs.append(
            Predicted(
                cell.name,
                cell.method,
                kept["ratio"],
                kept["ratio_low"],
                kept["ratio_high"],
                measured,
                kept["retained"],
                kept["total_cte_m"],
                cell.deployed.mean_m,
                learned / learned_none if learned_none > 0.0 else math.nan,
                learned / starts,
            )
        )
    return [pair for pair in pairs if math.isfinite(pair.measured) and math.isfinite(pair.surrogate)]


def prediction_file(folder: Path, name: str) -> Path:
    """Where the prediction of a cell is kept, in the folder of a campaign or of what was published of it."""
    return folder / "predictions" / f"{name}.json"


def kept_prediction(file: Path, settings_hash: str) -> dict[str, Any] | None:
    """A prediction that was made of a cell with these settings; None where there is none."""
    try:
        kept: dict[str, Any] = read_json(file)
    except (OSError, ValueError):
        return None
    return kept if kept.get("settings_hash") == settings_hash and kept.keys() >= _KEYS else None
