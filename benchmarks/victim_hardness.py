"""Judges a victim before any gradient runs against it: the worst of N random textures of families that it was not trained on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.clean import clean_drive
from advnerf_core.attack.methods import SearchRun, load_method
from advnerf_core.attack.spaces.space import Space
from advnerf_core.driving.metrics import no_effect_m
from advnerf_core.report.evidence.hardness import (
    FILE,
    FamilyHardness,
    HardnessError,
    HardnessVerdict,
    read_hardness,
    write_hardness,
)
from nodes.experiment.run.registering import VALIDATED_ON
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.spaces import make_space
from nodes.experiment.show.victims import load_victim
from nodes.experiment.steps.attack import (
    attack_problem,
    from_measured_starts,
    past,
    planned_evaluations,
    search_settings,
)

_SEED = 20_000  # no search uses it


def judge(experiment: Experiment, victim: str, textures: int = 0) -> HardnessVerdict:
    """Drive a victim with random textures of each validation family from the measured starts, and store the verdict in the run folder.

    Args:
        experiment: Experiment with scene and policies.
        victim: Name of the victim.
        textures: Number of textures per family; 0 draws as many as a search of the experiment may evaluate.

    Returns:
        The verdict; an existing one for this policy is returned.

    Raises:
        HardnessError: A gradient search of this run folder has begun, or three other recipes were judged.
    """
    record = read_hardness(experiment.folder / FILE)
    policy = load_victim(experiment, victim)
    known = next((each for each in record.verdicts if each.policy_sha256 == policy.sha256), None)
    if known is not None:
        return known
    _refuse_late(experiment, victim)
    count = textures or planned_evaluations(experiment)
    verdict = HardnessVerdict(
        victim=victim,
        policy_sha256=policy.sha256,
        recipe=experiment.config.training(victim).policy.recipe,
        trained_on=experiment.config.training(victim).policy.families,
        validated_on=VALIDATED_ON,
        textures=count,
        seed=_SEED,
        starts=experiment.config.measure.starts,
        margin_m=no_effect_m(experiment.limits.off_track_m),
        families=tuple(family_hardness(experiment, victim, VALIDATED_ON, count)),
    )
    write_hardness(experiment.folder / FILE, record.with_verdict(verdict))
    return verdict


def family_hardness(
    experiment: Experiment, victim: str, families: Sequence[str], textures: int
) -> Iterator[FamilyHardness]:
    """Effect of random textures of some families on a victim in the surrogate, scenario by scenario.

    Args:
        experiment: Experiment with scene and policies.
        victim: Name of the victim.
        families: Methods that draw the textures.
        textures: Number of textures per family; each is driven from all measured starts.
    """
    space = make_space(experiment, None)
    policy = load_victim(experiment, victim)
    for scenario in experiment.config.paths:
        problem = attack_problem(experiment, space, policy, scenario, _SEED)
        problem = from_measured_starts(experiment, scenario, problem)
        none_m = np.array(clean_drive(past(problem, space, space.plain), space.plain.colours).total_cte_m)
        for family in families:
            driven_m = _totals_m(experiment, space, problem, family, textures)
            yield FamilyHardness.of(scenario, family, (driven_m - none_m) / problem.steps)


def _totals_m(
    experiment: Experiment, space: Space, problem: AttackProblem, family: str, textures: int
) -> np.ndarray:
    """Total CTE of every texture and start, ``[textures, starts]`` [m]."""
    settings = replace(search_settings(experiment, load_method(family)), evaluations=textures)
    found = space.search(family, problem, settings, SearchRun(_SEED, None, None, ""))
    return np.array([each.protocol_cte_m for each in found.history])


def _refuse_late(experiment: Experiment, victim: str) -> None:
    """Raise after a gradient search: a later verdict shows nothing about the choice of the victim."""
    for cell in experiment.cells:
        folder = experiment.cell_folder(cell)
        if cell.victim == victim and cell.method.startswith("gradient") and folder.exists():
            raise HardnessError(
                f"expected to judge the victim before any gradient search, got one in {folder}; name another run folder, or leave the victim "
                "unjudged: pages call it trained with textures"
            )
