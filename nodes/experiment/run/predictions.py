"""Predicted and measured transfer: one prediction per attacked cell, made without its deployed drives, and its accuracy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advnerf_core.files import write_json
from advnerf_core.report.cells import CellResult
from advnerf_core.report.conditions import CONTROLS
from advnerf_core.report.evidence.rows import CellDrives
from advnerf_core.report.predictions import Predicted
from nodes.experiment.engine.artefact import read_current
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import is_predictable
from nodes.experiment.run.store import Store
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.keys import settings_hash

if TYPE_CHECKING:
    from nodes.experiment.run.gate import GateDrive

_KEYS = {"excess_m", "excess_low_m", "excess_high_m", "retained", "clean_drive"}


def predict_cells(
    experiment: Experiment, cells: Sequence[Cell], say: Callable[[str], None], draws: int | None = None
) -> int:
    """Predict every attacked cell with a search and without a prediction; returns their number.

    A prediction needs the finished search (``advnerf experiment run --search-only`` does only that) and the drive without attack. It reads
    no drive with the attack, so it is the same before and after that drive. What was predicted, and what could not be, is said.
    """
    from nodes.experiment.run.gate import DEFAULT_DRAWS, lacks, predict_cell  # loads torch

    draws = DEFAULT_DRAWS if draws is None else draws
    store, made = Store(experiment.folder), 0
    clean: dict[tuple[str, str, int], GateDrive] = {}
    for cell in cells:
        if not cell.searched:
            continue
        inside = experiment.of(cell)
        if not is_predictable(inside):
            continue
        # Work with other settings may have a search too, of another attack.
        key = settings_hash(inside, cell.inside)
        file = prediction_file(experiment.folder, cell.name)
        kept = kept_prediction(file, key)
        if kept is not None and kept.get("draws") == draws:
            continue
        if not store.has_begun(cell.name, key):
            if kept is not None or store.result(cell.name) is not None:
                say(f"{cell.name}: not predicted, as its search is not in {store.work(cell.name)}")
            continue
        which = (inside, cell.inside, store.work(cell.name))
        if lacking := lacks(*which):
            say(f"{cell.name}: not predicted, as it lacks {lacking}")
            continue
        drive = (cell.scenario, cell.victim, cell.seed)
        found, clean[drive] = predict_cell(*which, draws, clean.get(drive))
        summary = clean[drive].agreement.summary()
        record = {"settings_hash": key, **found.record(), "clean_drive": summary}
        write_json(file, record)
        say(
            f"{cell.name}: excess of {found.excess_m_per_tick[1]:.3f} m per tick expected, {100 * found.retained:.0f} % of the effect survives"
        )
        made += 1
    return made


def predicted(folder: Path, results: Sequence[CellResult]) -> list[Predicted]:
    """Predictions of finished cells, each with the measured values, from the folder of an experiment or of its published set."""
    pairs, drives = [], CellDrives(results)
    for cell in results:
        kept = kept_prediction(prediction_file(folder, cell.name), cell.settings_hash)
        deployed = drives.outcomes(cell, "deployed")
        if kept is None or not deployed or cell.method in CONTROLS:
            continue
        learned = drives.outcomes(cell, "surrogate")[: len(deployed)]
        pairs.append(
            Predicted(
                cell.name,
                cell.method,
                kept["excess_m"],
                kept["excess_low_m"],
                kept["excess_high_m"],
                kept["retained"],
                sum(each.excess_cte_m_per_tick for each in learned) / len(learned),
                tuple(each.excess_cte_m_per_tick for each in deployed),
            )
        )
    return pairs


def prediction_file(folder: Path, name: str) -> Path:
    """File of a cell's prediction, in the folder of an experiment or of its published set."""
    return folder / "predictions" / f"{name}.json"


def kept_prediction(file: Path, settings_hash: str) -> dict[str, Any] | None:
    """The stored prediction of a cell with these settings; None without one."""
    kept = read_current(file, settings_hash=settings_hash)
    return kept if kept is not None and kept.keys() >= _KEYS else None
