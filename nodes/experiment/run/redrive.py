"""Driving published cells again: drives in the surrogate past a published attack must come out as they were published."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from advnerf_core.report.cells import read_cell
from advnerf_core.report.conditions import NONE
from advnerf_core.report.evidence.kept import KeptDrive, kept_drives
from advnerf_core.report.evidence.kept_build import LOST, is_kept
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import Bench
from nodes.experiment.run.config import Campaign
from nodes.experiment.run.kept_attacks import attack_file
from nodes.experiment.run.plan import read_experiment
from nodes.experiment.steps.attack import surrogate_drives, surrogate_part
from nodes.experiment.steps.run import prepare_victims
from nodes.experiment.steps.search_files import ATTACK
from nodes.runtime.errors import RuntimeFault

# Of positions, between machines: sums are taken in another order, and a search takes many steps.
TOLERANCE_M = 0.05


class RedriveError(RuntimeFault):
    """A published cell cannot be driven again here."""


@dataclass(frozen=True)
class Redriven:
    """A cell that was driven again.

    Attributes:
        name: Of the cell.
        off_m: Largest distance of a pose from the published one [m].
        same: Whether that is within `TOLERANCE_M`.
    """

    name: str
    off_m: float
    same: bool


def redrive(
    campaign: Campaign, published: Path, count: int, seed: int, tell: Callable[[str], None]
) -> list[Redriven]:
    """Drive some cells of a set again, in the surrogate, with the scene, the victim and the attacks that are kept.

    Args:
        campaign: The registered cells, with a run folder that may be empty.
        published: Folder of the set.
        count: How many cells, drawn at random.
        seed: Of the draw.
        tell: Told which cell is driven.

    Raises:
        RedriveError: The set's scene and victim were not kept.
    """
    if not is_kept(published):
        raise RedriveError(f"{published.name} {LOST}")
    names = {file.stem for file in published.glob("*.json")}
    known = [cell for cell in campaign.cells if cell.name in names]
    chosen = random.Random(seed).sample(known, min(count, len(known)))
    found = []
    for cell in chosen:
        tell(f"{cell.name}: driven again")
        said = read_cell(published / f"{cell.name}.json")
        again = _again(campaign, cell, attack_file(published, said.attack_id or NONE))
        found.append(_compared(cell.name, said.kept["surrogate"], again))
    return found


def _again(campaign: Campaign, cell: Cell, attack: Path) -> list[KeptDrive]:
    """Drives in the surrogate past the published attack; of a set without attacks, past what its search finds again."""
    experiment = read_experiment(campaign, cell)
    prepare_victims(experiment)
    with TemporaryDirectory() as work, Bench(experiment) as bench:
        inside, folder = campaign.inside(cell), Path(work)
        if attack.exists():
            shutil.copy(attack, folder / ATTACK)
            found = surrogate_drives(experiment, bench.space, inside, folder)
        else:
            found = surrogate_part(experiment, bench.space, inside, folder, lambda fraction, text="": None)
    return [KeptDrive.model_validate(each) for each in kept_drives(found)]


def _compared(name: str, said: tuple[KeptDrive, ...], again: list[KeptDrive]) -> Redriven:
    if len(said) != len(again):
        return Redriven(name, float("inf"), False)
    off_m = max(
        float(np.hypot(*(one.poses() - other.poses())[:, :2].T).max())
        for one, other in zip(said, again, strict=True)
    )
    return Redriven(name, off_m, off_m <= TOLERANCE_M)
