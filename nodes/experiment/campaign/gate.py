"""The fidelity gate of an experiment, and predictions of how its attacks transfer, for any kind of scenario.

The package of a kind has a module ``fidelity`` with ``policy_of``, ``held_out``, ``driven``, ``lacks``, ``attacked`` and ``loop``; a kind without
one has no gate. See `nodes/experiment/fidelity.py`.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.attack.transfer import TransferPrediction, predict_transfer
from advnerf_core.files import write_atomically
from advnerf_core.scene.fidelity import Agreement, Effect, Pictures, Verdict, agreement, judge
from advnerf_core.scene.gate_limits import GateLimits
from nodes.experiment.campaign.kinds import Kind, stage_digests
from nodes.experiment.stages import hash_of
from nodes.lab.policy_data.evaluate import predict
from nodes.runtime.errors import RuntimeFault


@dataclass(frozen=True)
class CleanDrive:
    """What predictions of all attacks on one drive share.

    Attributes:
        agreement: How alike real and learned pictures are along the deployed drive without attack.
        none_m: Total CTE of each draw without attack [m].
    """

    agreement: Agreement
    none_m: tuple[float, ...]


class GateError(RuntimeFault):
    """A surrogate is not good enough for attacks found in it to mean anything."""


def agreement_on(policy: Any, goal: tuple[float, ...], pictures: Pictures) -> Agreement:
    """How alike pictures look, and how alike the policy steers on them."""
    steering = [predict(policy, images, goal) for images in (pictures.real, pictures.learned)]
    return agreement(list(pictures.real), list(pictures.learned), *steering)


def judge_scene(
    kind: Kind, experiment: Any, scenario: str, victim: str, limits: GateLimits, bag: Path | None = None
) -> list[tuple[str, Verdict]]:
    """The gate's verdicts: on held-out views, and on a driven bag if one is given.

    Raises:
        GateError: The kind has no pictures to judge by.
    """
    module = kind.fidelity
    if module is None:
        raise GateError(
            f"expected a module fidelity beside the cells of kind {kind.name}, got none; it has no gate"
        )
    policy, goal = module.policy_of(experiment, victim, scenario)
    sets = [module.held_out(experiment, scenario)]
    if bag is not None:
        sets.append(module.driven(experiment, scenario, victim, 0, Path(), bag))
    return [(each.of, judge(agreement_on(policy, goal, each), limits, each.of)) for each in sets]


def cached_verdict(
    kind: Kind,
    experiment: Any,
    scenario: str,
    victim: str,
    limits: GateLimits,
    file: Path,
    drive: tuple[int, Path] | None = None,
) -> Verdict | None:
    """The verdict on held-out views, or on a drive; judged again only if scene, policy or limits changed; None where the kind has no gate.

    Args:
        kind: Kind of the scenario.
        experiment: Its experiment.
        scenario: What the experiment calls it.
        victim: Which policy.
        limits: What must be reached.
        file: Where the verdict is kept.
        drive: Of a deployed drive without attack its seed and the folder of its cell.

    Raises:
        RuntimeFault: There is no such drive yet.
    """
    module = kind.fidelity
    if module is None:
        return None
    policy, goal = module.policy_of(experiment, victim, scenario)
    which = [scenario, victim, *(["drive", drive[0]] if drive else [])]
    key = hash_of(
        [stage_digests(experiment.folder), _weights_sha256(policy), limits.model_dump(mode="json"), *which]
    )
    try:
        kept = json.loads(file.read_text(encoding="utf-8"))
        if kept["key"] == key:
            return Verdict(kept["passed"], tuple(kept["reasons"]), kept["numbers"])
    except (OSError, ValueError, KeyError, TypeError):
        pass  # an unreadable verdict is judged again
    pictures = (
        module.driven(experiment, scenario, victim, *drive)
        if drive
        else module.held_out(experiment, scenario)
    )
    verdict = judge(agreement_on(policy, goal, pictures), limits, pictures.of)
    write_atomically(file, json.dumps({"key": key, **verdict.record()}, indent=1) + "\n")
    return verdict


def _weights_sha256(policy: Any) -> str:
    """Hash of a network's weights; a retrained one is of no stage that all cells need."""
    digest = hashlib.sha256()
    for name, weight in sorted(getattr(policy, "state_dict", dict)().items()):
        digest.update(name.encode() + weight.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


def predict_cell(
    kind: Kind,
    experiment: Any,
    scenario: str,
    victim: str,
    method: str,
    seed: int,
    folder: Path,
    draws: int = 6,
    clean: CleanDrive | None = None,
) -> tuple[TransferPrediction, CleanDrive]:
    """Predict the deployed drives of a cell whose search is finished, from pictures and the surrogate alone.

    Args:
        kind: Kind of the scenario.
        experiment: Its experiment.
        scenario: What the experiment calls it.
        victim: Which policy.
        method: Which search.
        seed: Of the search.
        folder: The cell's folder.
        draws: Drives per prediction.
        clean: What an earlier prediction of the same scenario, victim, seed and draws returned of the drive without attack.

    Returns:
        The prediction, and what it says of the drive without attack.
    """
    module = kind.fidelity
    if module is None:
        raise GateError(
            f"expected a module fidelity beside the cells of kind {kind.name}, got none; it has no predictions"
        )
    policy, goal = module.policy_of(experiment, victim, scenario)
    without = (
        clean.agreement
        if clean
        else agreement_on(policy, goal, module.driven(experiment, scenario, victim, seed, folder))
    )
    with_attack = agreement_on(
        policy, goal, module.attacked(experiment, scenario, victim, method, seed, folder)
    )
    effect = Effect(with_attack.learned - without.learned, with_attack.real - without.real)
    problem, images, starts, horizon = module.loop(experiment, scenario, victim, method, seed, folder)
    none_m = clean.none_m if clean else None
    found = predict_transfer(problem, images, without, effect, starts, horizon, draws, seed, none_m)
    return found, CleanDrive(without, found.none_m)
