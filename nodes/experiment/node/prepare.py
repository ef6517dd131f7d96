"""Loads everything that the search of a request needs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from nodes.experiment.node.request import as_text, require_request
from nodes.experiment.plan.cell import Cell
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.spaces import make_space
from nodes.experiment.steps.attack import Prepared
from nodes.experiment.steps.run import load_experiment, make_ready


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


def prepare(experiment: Experiment, seed: int | None = None) -> Prepared:
    """Load scene, policy, calibration and objects of a request, and bake the scene; ``seed`` is its first if not given.

    Raises:
        AdvnerfError: A file is missing, damaged, or does not fit the others.
    """
    make_ready(experiment, console=Console(quiet=True))
    seed = experiment.config.seeds[0] if seed is None else seed
    return Prepared.of(experiment, make_space(experiment, None), searched_cell(experiment, seed))


def searched_cell(experiment: Experiment, seed: int) -> Cell:
    """The search of a request with one seed."""
    config = experiment.config
    return Cell.of(config.cell_paths[0], config.main_victim, config.methods[0], seed)
