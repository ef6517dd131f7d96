"""Repeats published drives: drives in the surrogate past a published attack must give the published result.

A set keeps the keys that it was published with. Its stages are found by their digests, which its cells name, so that the keys of
this version do not matter; if this version would drive differently, the set must be repeated with the version that published it.
"""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from advnerf_core.report.cells import CellResult, read_cell
from advnerf_core.report.conditions import NONE
from advnerf_core.report.evidence.kept import KeptDrive, kept_drives
from advnerf_core.report.evidence.kept_build import LOST, is_kept
from advnerf_core.report.evidence.registration import read_registration
from advnerf_core.report.evidence.verifying.git import last_commit
from nodes.experiment.engine.artefact import BUILD, VICTIM, Artefact, ReferenceBuild
from nodes.experiment.engine.run_folder import ATTACK
from nodes.experiment.engine.stages import key_of
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import Bench
from nodes.experiment.run.kept_attacks import attack_file
from nodes.experiment.run.registering import registered_scenario
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.victims import look_at_given
from nodes.experiment.steps.attack import surrogate_drives, surrogate_part
from nodes.experiment.steps.pipeline import stages_of
from nodes.experiment.steps.run import prepare_victims
from nodes.runtime.errors import RuntimeFault

# Of positions, between machines: sums are taken in another order, and a search takes many steps.
TOLERANCE_M = 0.05
# Fields of a registration that determine drives: this version must derive the same from the experiment file to repeat them.
_DRIVEN = ("path", "ticks", "dt_s", "off_track_m", "held_cap_m", "starts")


class RedriveError(RuntimeFault):
    """A published cell cannot be driven again here."""


@dataclass(frozen=True)
class Redriven:
    """A cell that was driven again.

    Attributes:
        off_m: Largest distance of a pose from the published one [m].
        same: Whether that is within `TOLERANCE_M`.
    """

    name: str
    off_m: float
    same: bool


def redrive(
    experiment: Experiment, published: Path, count: int, seed: int, tell: Callable[[str], None]
) -> list[Redriven]:
    """Drive some cells of a set again, drawn at random, in the surrogate, with the published scene, victim and attacks.

    The run folder of the registered experiment may be empty.

    Raises:
        RedriveError: The set's scene and victim are not published, or this version would drive differently.
    """
    if not is_kept(published):
        raise RedriveError(f"{published.name} {LOST}")
    names = {file.stem for file in published.glob("*.json")}
    known = [cell for cell in experiment.cells if cell.name in names]
    chosen = random.Random(seed).sample(known, min(count, len(known)))
    found = []
    for cell in chosen:
        tell(f"{cell.name}: driven again")
        said = read_cell(published / f"{cell.name}.json")
        variant = experiment.of(cell)
        look_at_given(variant)
        _take_stages(variant, said, ReferenceBuild(published.parent / BUILD))
        _require_same_drives(variant, cell, published)
        again = _again(variant, cell.inside, attack_file(published, said.attack_id or NONE))
        found.append(_compared(cell.name, said.kept["surrogate"], again))
    return found


def kept_victims(published: Path, into: Path) -> list[str]:
    """Copy the existing victims of a set that are kept beside it into a folder; returns the changes of its experiment by which they are its victims.

    Raises:
        ReferenceBuildError: Their files differ from the kept ones.
    """
    registration, build = read_registration(published), ReferenceBuild(published.parent / BUILD)
    scenarios = () if registration is None else registration.scenarios.values()
    digests = {name: sha for each in scenarios for name, sha in each.victims.get("policies", {}).items()}
    found = {name: build.take_digest(VICTIM, sha, sha, into / name) for name, sha in digests.items()}
    return [
        f"victims.{name}.policy={json.dumps(str(into / name / record.settings['policy']))}"
        for name, record in found.items()
        if record is not None
    ]


def unreadable(published: Path, why: str) -> RedriveError:
    """The error for a published set that this version reads differently from the one that published it, and in what."""
    commit = last_commit(published)
    of = f", git checkout {commit[:12]}" if commit else ""
    return RedriveError(f"{published.name}: {why}; drive it again with the version that published it{of}")


def _require_same_drives(variant: Experiment, cell: Cell, published: Path) -> None:
    """Raise if this version would drive differently from the registered drives."""
    registration = read_registration(published)
    then = None if registration is None else registration.scenarios.get(cell.scenario)
    now = registered_scenario(variant, cell.path)
    if differ := [name for name in _DRIVEN if then is not None and getattr(then, name) != getattr(now, name)]:
        raise unreadable(published, f"expected the {', '.join(differ)} that were registered, got others")


def _take_stages(experiment: Experiment, said: CellResult, build: ReferenceBuild) -> None:
    """Put the stages of a published cell into the run folder, as if this version had made them."""
    records: dict[str, Artefact] = {}
    for stage in stages_of(experiment):
        if stage.name in said.stages:
            key, folder = key_of(stage, records), experiment.stage_folder(stage.name)
            found = build.take_digest(stage.name, said.stages[stage.name], key, folder)
            if found is None:
                raise RedriveError(f"{said.name} {LOST}")
            records[stage.name] = found


def _again(experiment: Experiment, cell: Cell, attack: Path) -> list[KeptDrive]:
    """Drives in the surrogate past the published attack; for a set without attacks, past the result of a repeated search."""
    prepare_victims(experiment)
    with TemporaryDirectory() as work, Bench(experiment) as bench:
        folder = Path(work)
        if attack.exists():
            shutil.copy(attack, folder / ATTACK)
            found = surrogate_drives(experiment, bench.space, cell, folder)
        else:
            found = surrogate_part(experiment, bench.space, cell, folder, lambda fraction, text="": None)
    return [KeptDrive.model_validate(each) for each in kept_drives(found)]


def _compared(name: str, said: tuple[KeptDrive, ...], again: list[KeptDrive]) -> Redriven:
    if len(said) != len(again):
        return Redriven(name, float("inf"), False)
    off_m = max(
        float(np.hypot(*(one.poses() - other.poses())[:, :2].T).max())
        for one, other in zip(said, again, strict=True)
    )
    return Redriven(name, off_m, off_m <= TOLERANCE_M)
