"""Is a hardened victim hard? Drives past random textures, also of families that it was not trained on, compared with no attack."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from advnerf_core.attack.clean import clean_drive
from advnerf_core.attack.methods import SearchRun, load_method
from advnerf_core.driving.metrics import mean_cte_limit_m
from advnerf_core.policies.pilotnet import load_policy
from advnerf_core.report.evidence.intervals import Equivalence, equivalence
from nodes.experiment.attack import attack_problem, from_measured_starts, past, search_settings
from nodes.experiment.context import Experiment
from nodes.experiment.policy import victim_file
from nodes.experiment.spaces import make_space

# The victim is trained on textures of the first family; the others validate it.
TRAINED_ON = "random"
FAMILIES = (TRAINED_ON, "random_coarse", "random_levels", "random_pink", "random_natural")
_SEED = 20_000  # no search has it


@dataclass(frozen=True)
class Hardness:
    """One victim past random textures of one family, in the surrogate.

    Attributes:
        scenario: Which path.
        family: Method that draws the textures.
        worst_m: Excess of the worst texture, the mean over its starts [m per tick].
        test: Whether the mean excess is equivalent to none.
    """

    scenario: str
    family: str
    worst_m: float
    test: Equivalence


def margin_m(experiment: Experiment) -> float:
    """Mean excess per tick that counts as no effect [m]: half of what a victim that drives well may be off without attack."""
    return 0.5 * mean_cte_limit_m(experiment.limits.off_track_m)


def hardness(experiment: Experiment, victim: str, textures: int = 12) -> Iterator[Hardness]:
    """Drive a victim past random textures of each family, from the measured starts.

    Args:
        experiment: With scene and policies.
        victim: Which policy.
        textures: Drawn per family; all starts pass each.
    """
    space = make_space(experiment, None)
    policy = load_policy(victim_file(experiment, victim))
    for scenario in experiment.config.scenarios:
        problem = attack_problem(experiment, space, policy, scenario, _SEED)
        problem = from_measured_starts(experiment, scenario, problem)
        none_m = np.array(clean_drive(past(problem, space, space.plain), space.plain.colours).total_cte_m)
        for family in FAMILIES:
            settings = replace(search_settings(experiment, load_method(family)), evaluations=textures)
            found = space.search(family, problem, settings, SearchRun(_SEED, None, None, ""))
            driven_m = np.array([each.protocol_cte_m for each in found.history])
            excess_m = (driven_m - none_m) / problem.steps
            test = equivalence(excess_m, margin_m(experiment))
            assert test is not None, "several textures from several starts were driven"
            yield Hardness(scenario, family, float(excess_m.mean(axis=1).max()), test)
