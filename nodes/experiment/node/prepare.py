"""Loads everything that the search of a request needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from rich.console import Console

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
from nodes.experiment.steps.pipeline import stages_of
from nodes.experiment.steps.run import load_experiment, make_ready
from nodes.experiment.steps.shared_search import search_key


def load_request(file: Path, overrides: Sequence[str] = (), folder: Path | None = None) -> Experiment:
    """Read an experiment file with a single request; see `load_experiment`.

    Raises:
        ConfigError: A key is unknown or a value wrong, reported with file and line; or the experiment is not a single request.
    """
    experiment = load_experiment(file, None, overrides, folder)
    require_request(experiment.config, str(file))
    return experiment


def request_text(experiment: Experiment) -> str:
    """YAML text from which the same request is read on the same machine."""
    return as_text(experiment.config, experiment.named_world)


@dataclass(frozen=True, eq=False)
class Prepared:
    """An attack, ready for the search.

    Attributes:
        cell: The victim, path and method of the attack, and the seed of starts, search and disturbances.
        policy: The victim with its view and hash.
    """

    experiment: Experiment
    cell: Cell
    policy: LoadedPolicy
    space: Space
    problem: AttackProblem

    @property
    def seed(self) -> int:
        """Seed of starts, search and disturbances."""
        return self.cell.seed

    @property
    def settings_hash(self) -> str:
        """Hash of everything that must be the same when a search is resumed."""
        return search_key(self.experiment, self.cell)

    def with_seed(self, seed: int) -> Prepared:
        """The same attack with another seed: other starts, other draws."""
        cell = replace(self.cell, seed=seed)
        return replace(self, cell=cell, problem=_problem(self.experiment, self.space, self.policy, cell))

    @cached_property
    def clean_drive(self) -> CleanDrive:
        """The victim's drive past the plain objects, from the same starts in the same scene."""
        plain = self.space.plain
        return clean_drive(past(self.problem, self.space, plain), plain.colours)


def prepare(experiment: Experiment, seed: int | None = None) -> Prepared:
    """Load scene, policy, calibration and objects of a request, and bake a splat; ``seed`` is its first if not given.

    Raises:
        AdvnerfError: A file is missing, damaged, or does not fit the others.
    """
    look_at_given(experiment)
    if stages_of(experiment):
        make_ready(experiment, console=Console(quiet=True))
    config = experiment.config
    seed = config.seeds[0] if seed is None else seed
    cell = Cell.of(config.cell_paths[0], config.main_victim, config.methods[0], seed)
    policy, space = load_victim(experiment, cell.victim), make_space(experiment, None)
    return Prepared(experiment, cell, policy, space, _problem(experiment, space, policy, cell))


def _problem(experiment: Experiment, space: Space, policy: LoadedPolicy, cell: Cell) -> AttackProblem:
    return attack_problem(experiment, space, policy, cell.scenario, cell.seed)
