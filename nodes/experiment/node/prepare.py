"""From a request to everything a search needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.clean import clean_drive
from advnerf_core.attack.spaces.space import Space
from advnerf_core.driving.clean_drive import CleanDrive
from advnerf_core.policies.policy_file import LoadedPolicy
from nodes.experiment.node.request import as_text, require_request
from nodes.experiment.plan.cell import Cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.spaces import make_space
from nodes.experiment.show.victims import load_victim, look_at_given
from nodes.experiment.steps.attack import attack_problem, past
from nodes.experiment.steps.run import load_experiment
from nodes.experiment.steps.shared_search import search_key


def load_request(file: Path, overrides: Sequence[str] = (), folder: Path | None = None) -> Experiment:
    """Read an experiment that is one request.

    Args:
        file: A ``*.experiment.yaml`` file.
        overrides: ``section.key=value`` texts.
        folder: Where its search is kept; None for the file's ``run_folder``, or ``runs/<name>``.

    Raises:
        ConfigError: Anything unknown or wrong, with file and line; or another experiment.
    """
    experiment = load_experiment(file, None, overrides, folder)
    require_request(experiment.config, str(file))
    return experiment


def request_text(experiment: Experiment) -> str:
    """YAML text from which the same request is read on the same machine."""
    return as_text(experiment.config, experiment.named_world)


@dataclass(frozen=True, eq=False)
class Prepared:
    """An attack, ready to be searched for.

    Attributes:
        experiment: What was asked for.
        cell: Its victim, path and method, and the seed of starts, search and disturbances.
        policy: The victim with its view and hash.
        space: What is searched.
        problem: What the searches take.
    """

    experiment: Experiment
    cell: Cell
    policy: LoadedPolicy
    space: Space
    problem: AttackProblem

    @property
    def seed(self) -> int:
        """Of starts, search and disturbances."""
        return self.cell.seed

    @property
    def settings_hash(self) -> str:
        """Names everything that must not change between a search and its resumption."""
        return search_key(self.experiment, self.cell)

    def with_seed(self, seed: int) -> Prepared:
        """The same with another seed: other starts, other draws."""
        cell = replace(self.cell, seed=seed)
        return replace(self, cell=cell, problem=_problem(self.experiment, self.space, self.policy, cell))

    @cached_property
    def clean_drive(self) -> CleanDrive:
        """The victim's drive past the plain objects, from the same starts in the same scene."""
        plain = self.space.plain
        return clean_drive(past(self.problem, self.space, plain), plain.colours)


def prepare(experiment: Experiment, seed: int | None = None) -> Prepared:
    """Load scene, policy, calibration and objects of a request; ``seed`` is its first if not given.

    Raises:
        AdvnerfError: A file is missing, damaged, or does not fit the others.
    """
    look_at_given(experiment)
    config = experiment.config
    seed = config.seeds[0] if seed is None else seed
    cell = Cell.of(config.cell_paths[0], config.main_victim, config.methods[0], seed)
    policy, space = load_victim(experiment, cell.victim), make_space(experiment, None)
    return Prepared(experiment, cell, policy, space, _problem(experiment, space, policy, cell))


def _problem(experiment: Experiment, space: Space, policy: LoadedPolicy, cell: Cell) -> AttackProblem:
    return attack_problem(experiment, space, policy, cell.scenario, cell.seed)
