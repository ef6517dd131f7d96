"""The fidelity gate of an experiment, and predictions of how its attacks transfer."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.attack.transfer import DEFAULT_DRAWS, TransferPrediction, predict_transfer
from advnerf_core.files import write_json
from advnerf_core.scene.fidelity import Effect, PicturePairs, SceneAgreement, Verdict, agreement, judge
from advnerf_core.scene.gate_limits import GateLimits
from nodes.experiment.engine.artefact import digests_in, hash_of, read_current
from nodes.experiment.plan.cell import Cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps import fidelity
from nodes.experiment.steps.keys import clean_folder, stages_needed
from nodes.lab.policy_data.evaluate import predict


@dataclass(frozen=True)
class GateDrive:
    """Common data of the predictions of all attacks on one drive.

    Attributes:
        agreement: Agreement of real and learned pictures along the deployed drive without attack.
        none_m: Total CTE of each draw without attack [m].
    """

    agreement: SceneAgreement
    none_m: tuple[float, ...]


def agreement_on(policy: Any, goal: tuple[float, ...], pictures: PicturePairs) -> SceneAgreement:
    """Agreement of pictures, and of the policy's steering on them."""
    steering = [predict(policy, images, goal) for images in (pictures.real, pictures.learned)]
    return agreement(list(pictures.real), list(pictures.learned), *steering)


def judge_scene(
    experiment: Experiment, cell: Cell, limits: GateLimits, bag: Path | None = None
) -> list[tuple[str, Verdict]]:
    """The gate's verdicts: on held-out views, and on a driven bag if one is given."""
    policy, goal = fidelity.policy_of(experiment, cell)
    sets = [fidelity.held_out(experiment)]
    if bag is not None:
        sets.append(fidelity.driven(experiment, cell, Path(), bag))
    return [(each.of, judge(agreement_on(policy, goal, each), limits, each.of)) for each in sets]


def cached_verdict(
    experiment: Experiment,
    cell: Cell,
    limits: GateLimits,
    file: Path,
    drive: Path | None = None,
    published: Sequence[Path] = (),
) -> Verdict:
    """The verdict on held-out views, or on a drive; judged again only if scene, policy or limits changed.

    A set has one verdict on a scene and victim, so that a published one is taken over: judged on another machine, its last digits differ.

    Args:
        cell: The cell without attack that has the drive, with its name in the experiment.
        drive: Folder of the cell, if its drive is to be judged.
        published: Files that may have the verdict, besides its own.

    Raises:
        RuntimeFault: The drive does not exist yet.
    """
    policy, goal = fidelity.policy_of(experiment, cell)
    which = [cell.scenario, cell.victim, *(["drive", cell.seed] if drive else [])]
    stages = digests_in(experiment.folder, stages_needed(experiment.config, cell.victim))
    key = hash_of([stages, _weights_sha256(policy), limits.model_dump(mode="json"), *which])
    for known in (file, *published):
        if (kept := read_current(known, key=key)) is not None:
            if known != file:
                write_json(file, kept)
            return Verdict(kept["passed"], tuple(kept["reasons"]), kept["numbers"])
    pictures = (
        fidelity.driven(experiment, cell, clean_folder(experiment, cell, drive))
        if drive
        else fidelity.held_out(experiment)
    )
    verdict = judge(agreement_on(policy, goal, pictures), limits, pictures.of)
    write_json(file, {"key": key, **verdict.record()})
    return verdict


def _weights_sha256(policy: Any) -> str:
    """Hash of a network's weights; a retrained one belongs to no stage that all cells need."""
    digest = hashlib.sha256()
    for name, weight in sorted(getattr(policy, "state_dict", dict)().items()):
        digest.update(name.encode() + weight.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


def lacks(experiment: Experiment, cell: Cell, folder: Path) -> str:
    """Missing inputs of a prediction, as text; empty if complete."""
    return fidelity.lacks(experiment, cell, folder, clean_folder(experiment, cell, folder))


def predict_cell(
    experiment: Experiment,
    cell: Cell,
    folder: Path,
    draws: int = DEFAULT_DRAWS,
    clean: GateDrive | None = None,
) -> tuple[TransferPrediction, GateDrive]:
    """Predict the deployed drives of a cell whose search is finished, from pictures and the surrogate alone.

    Args:
        cell: The cell, with its name in the experiment.
        clean: The second result of an earlier prediction of the same scenario, victim, seed and draws.

    Returns:
        The prediction, and its data about the drive without attack.
    """
    policy, goal = fidelity.policy_of(experiment, cell)
    at = clean_folder(experiment, cell, folder)
    without = clean.agreement if clean else agreement_on(policy, goal, fidelity.driven(experiment, cell, at))
    with_attack = agreement_on(policy, goal, fidelity.attacked(experiment, cell, folder, at))
    effect = Effect(with_attack.learned - without.learned, with_attack.real - without.real)
    problem, car, images, starts, horizon = fidelity.loop(experiment, cell, folder, at)
    none_m = clean.none_m if clean else None
    found = predict_transfer(problem, car, images, without, effect, starts, horizon, draws, cell.seed, none_m)
    return found, GateDrive(without, found.none_m)
