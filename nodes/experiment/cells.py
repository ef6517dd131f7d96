"""One entry of the transfer table, from the search to the deployed drive and its film; a finished part is not done again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from advnerf_core.attack.artifact import PLACES, load_attack
from advnerf_core.attack.methods import require_method
from advnerf_core.attack.spaces.space import Space
from advnerf_core.plugins import PluginError
from advnerf_core.policies.pilotnet import load_policy
from advnerf_core.report.conditions import NONE
from nodes.experiment import pose_maps, run
from nodes.experiment.attack import Cell, attack_path, surrogate_part
from nodes.experiment.campaign.kinds import stage_digests
from nodes.experiment.context import Experiment
from nodes.experiment.deploy import deployed_part, open_deployer
from nodes.experiment.films import film_cell, kept_film, with_film
from nodes.experiment.policy import RETRAINED, attackable, victim_file
from nodes.experiment.space_config import PlacesConfig
from nodes.experiment.spaces import make_space, over_the_world
from nodes.experiment.stages import hash_of
from nodes.runtime.errors import RuntimeFault
from nodes.runtime.progress import Report

TAKEN_FROM = "deploy"
_SEARCHED = 0.9  # share of a cell's work
prepare = run.prepare_victims
# What a cell does not depend on: which others there are, how much memory may be used, and what is told of the world elsewhere.
_FREE: Mapping[str, bool | set[str]] = {
    "name": True,
    "scenarios": True,
    "retrain": True,
    "world": True,
    "attack": {"seeds", "methods", "cache_mib"},
    "deploy": {"laps", "empty_scene", "ready_timeout_s"},
}


class CellError(RuntimeFault):
    """A cell was asked for that this experiment does not have."""


def cell_inputs(experiment: Experiment, scenario: str, victim: str, method: str, seed: int) -> dict[str, Any]:
    """What a cell depends on: the resolved world (of a server, not its address), settings, and what the stages before it wrote.

    Raises:
        CellError: No such drive, victim or method.
    """
    del seed
    require_known(experiment, scenario, victim, method)
    config = experiment.config.model_dump(mode="json", exclude=_FREE)
    inputs = {
        "config": config,
        "world": experiment.world_settings,
        "stages": stage_digests(experiment.folder),
    }
    if victim != RETRAINED:
        return inputs
    file = victim_file(experiment, victim)
    return {**inputs, "victim": load_policy(file).sha256 if file.exists() else None}


def runs_alone(experiment: Experiment) -> bool:
    """Whether the world can be open only once, as a server steps one world at a time, or live nodes measure time."""
    return experiment.traits.exclusive or experiment.config.deploy.live


def predictable(experiment: Experiment) -> bool:
    """Whether transfer can be predicted: a prediction composes the objects into pictures where they were placed by hand."""
    return has_learned_scene(experiment) and not isinstance(experiment.config.space, PlacesConfig)


def has_learned_scene(experiment: Experiment) -> bool:
    """Whether attacks are searched in a learned scene, which a fidelity gate can judge."""
    return not over_the_world(experiment)


def run_cell(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path, report: Report
) -> dict[str, Any]:
    """Search, drive in both domains, film, and keep the result in ``folder``.

    Args:
        experiment: Its scene, objects and policies must be there (``advnerf experiment FILE --until policy``).
        scenario: Name of the drive.
        victim: Name of the policy.
        method: none, or a method as `advnerf_core.attack.methods.load_method` takes it.
        seed: Of the search and its starts.
        folder: Where search states, attack files and results are kept.
        report: Told the finished fraction.

    Returns:
        The cell as JSON data: see `deploy.deployed_part`.

    Raises:
        CellError: No such drive, victim or method.
    """
    require_known(experiment, scenario, victim, method)
    cell = Cell.of(scenario, victim, method, seed)
    result, film = folder / f"{cell.name}.cell.json", kept_film(folder)
    if result.exists() and (film is not None or experiment.config.deploy.through == "nothing"):
        found: dict[str, Any] = json.loads(result.read_text())
        return with_film(found, film)
    with ExitStack() as stack:
        scene = stack.enter_context(experiment.open_world()) if over_the_world(experiment) else None
        space = make_space(experiment, scene)
        _search(experiment, space, cell, folder, report)
        if experiment.config.deploy.through == "nothing":
            return deployed_part(experiment, space, None, cell, folder, folder, partial(report, 1.0))
        deployer = open_deployer(experiment, stack, scene)
        tell = partial(report, _SEARCHED)
        tell("driving")
        clean = clean_folder(experiment, cell, folder)
        data = deployed_part(experiment, space, deployer, cell, folder, folder, tell, clean)
        return with_film(data, film_cell(experiment, deployer.scene, space, cell, folder, clean))


def clean_folder(experiment: Experiment, cell: Cell, folder: Path) -> Path:
    """Where the drives without attack of a cell go: live ones take half a minute each and belong to all methods."""
    if not experiment.config.deploy.live:
        return folder
    inputs = hash_of(cell_inputs(experiment, cell.scenario, cell.victim, NONE, cell.seed))
    return folder.parent / "shared" / f"{experiment.config.name}_{cell.clean.name}_{inputs[:12]}"


def search_cell(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path, report: Report
) -> None:
    """The part of `run_cell` that needs no deployment scene: search and drive in the surrogate.

    Raises:
        CellError: No such drive, victim or method.
    """
    require_known(experiment, scenario, victim, method)
    if not over_the_world(experiment):
        _search(
            experiment, make_space(experiment, None), Cell.of(scenario, victim, method, seed), folder, report
        )


def _search(experiment: Experiment, space: Space, cell: Cell, folder: Path, report: Report) -> None:
    for each in dict.fromkeys((cell.clean, cell)):
        surrogate_part(experiment, space, each, folder, report)


def require_known(experiment: Experiment, scenario: str, victim: str, method: str) -> None:
    """Refuse a cell that there cannot be.

    Raises:
        CellError: No such drive, victim or method.
    """
    known: tuple[tuple[str, str, Sequence[str]], ...] = (
        ("scenario", scenario, experiment.config.scenarios),
        ("victim", victim, attackable(experiment)),
    )
    for what, value, choices in known:
        if value not in choices:
            raise CellError(f"expected a {what} of {', '.join(choices)}, got {value!r}")
    if method != NONE:
        try:
            require_method(method)
        except PluginError as error:
            raise CellError(str(error)) from None


def draw_maps(
    experiment: Experiment,
    scenario: str,
    victim: str,
    seed: int,
    method: str,
    number: int,
    folder: Path,
    report: Report,
) -> list[Path]:
    """Loss landscape and robustness map of a finished cell of places; none of a cell that moved nothing.

    Raises:
        CellError: There is no object of this number.
    """
    cell = Cell.of(scenario, victim, method, seed)
    if method == NONE or not isinstance(experiment.config.space, PlacesConfig):
        return []
    count = len(experiment.objects)
    if not 0 <= number < count:
        raise CellError(f"expected an object of 0 to {count - 1}, got {number}")
    attack = load_attack(attack_path(folder, cell))
    assert attack.space == PLACES, "the file was written by a cell of this experiment"
    return pose_maps.draw_maps(experiment, cell, attack, number, folder, report)
