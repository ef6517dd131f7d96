"""One entry of the transfer table, from the search to the deployed drive and its film; a finished part is not done again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advnerf_core.attack.artifact import PLACES, load_attack
from advnerf_core.attack.methods import require_method
from advnerf_core.attack.spaces.space import Space
from advnerf_core.plugins import PluginError
from advnerf_core.policies.pilotnet import load_policy
from advnerf_core.report.conditions import NONE
from nodes.experiment import fidelity, pose_maps
from nodes.experiment.attack import attack_path, surrogate_part
from nodes.experiment.cell import Cell
from nodes.experiment.cell_kind import CellKind
from nodes.experiment.context import Experiment
from nodes.experiment.deploy import deployed_part, open_deployer
from nodes.experiment.films import film_cell, kept_film, with_film
from nodes.experiment.policy import RETRAINED, attackable, victim_file
from nodes.experiment.run import load_experiment, prepare_victims, stages_of
from nodes.experiment.space_config import PlacesConfig
from nodes.experiment.spaces import make_space, over_the_world
from nodes.experiment.stages import hash_of, is_current, stage_digests
from nodes.runtime.errors import RuntimeFault
from nodes.runtime.progress import Report

if TYPE_CHECKING:
    from advnerf_core.scene.fidelity import Pictures
    from nodes.experiment.cell_kind import Loop

_SEARCHED = 0.9  # share of a cell's work
# The stages that cells need of their experiment; what comes after is the cells themselves.
NEEDED = ("capture", "scene", "policy", "object")
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


def cell_inputs(experiment: Experiment, cell: Cell) -> dict[str, Any]:
    """What a cell depends on: the resolved world (of a server, not its address), settings, and what the stages before it wrote.

    Raises:
        CellError: No such drive, victim or method.
    """
    require_known(experiment, cell)
    config = experiment.config.model_dump(mode="json", exclude=_FREE)
    inputs = {
        "config": config,
        "world": experiment.world_settings,
        "stages": stage_digests(experiment.folder, NEEDED),
    }
    if cell.victim != RETRAINED:
        return inputs
    file = victim_file(experiment, cell.victim)
    return {**inputs, "victim": load_policy(file).sha256 if file.exists() else None}


def run_cell(experiment: Experiment, cell: Cell, folder: Path, report: Report) -> dict[str, Any]:
    """Search, drive in both domains, film, and keep the result in ``folder``.

    Args:
        experiment: Its scene, objects and policies must be there (``advnerf experiment FILE --until policy``).
        cell: Which.
        folder: Where search states, attack files and results are kept.
        report: Told the finished fraction.

    Returns:
        The cell as JSON data: see `deploy.deployed_part`.

    Raises:
        CellError: No such drive, victim or method.
    """
    require_known(experiment, cell)
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
    inputs = hash_of(cell_inputs(experiment, cell.clean))
    return folder.parent / "shared" / f"{experiment.config.name}_{cell.clean.name}_{inputs[:12]}"


def search_cell(experiment: Experiment, cell: Cell, folder: Path, report: Report) -> None:
    """The part of `run_cell` that needs no deployment scene: search and drive in the surrogate.

    Raises:
        CellError: No such drive, victim or method.
    """
    require_known(experiment, cell)
    if not over_the_world(experiment):
        _search(experiment, make_space(experiment, None), cell, folder, report)


def _search(experiment: Experiment, space: Space, cell: Cell, folder: Path, report: Report) -> None:
    for each in dict.fromkeys((cell.clean, cell)):
        surrogate_part(experiment, space, each, folder, report)


def require_known(experiment: Experiment, cell: Cell) -> None:
    """Refuse a cell that there cannot be.

    Raises:
        CellError: No such drive, victim or method.
    """
    known: tuple[tuple[str, str, Sequence[str]], ...] = (
        ("scenario", cell.scenario, experiment.config.scenarios),
        ("victim", cell.victim, attackable(experiment)),
    )
    for what, value, choices in known:
        if value not in choices:
            raise CellError(f"expected a {what} of {', '.join(choices)}, got {value!r}")
    if cell.method != NONE:
        try:
            require_method(cell.code)
        except PluginError as error:
            raise CellError(str(error)) from None


def draw_maps(experiment: Experiment, cell: Cell, number: int, folder: Path, report: Report) -> list[Path]:
    """Loss landscape and robustness map of a finished cell of places; none of a cell that moved nothing.

    Raises:
        CellError: There is no object of this number.
    """
    if cell.method == NONE or not isinstance(experiment.config.space, PlacesConfig):
        return []
    count = len(experiment.objects)
    if not 0 <= number < count:
        raise CellError(f"expected an object of 0 to {count - 1}, got {number}")
    attack = load_attack(attack_path(folder, cell))
    assert attack.space == PLACES, "the file was written by a cell of this experiment"
    return pose_maps.draw_maps(experiment, cell, attack, number, folder, report)


class ExperimentCells(CellKind):
    """Cells of experiment files; see `CellKind` for what each method does."""

    searches_apart = True

    def load(self, file: Path, setting: str, overrides: Sequence[str], folder: Path) -> Experiment:
        """Read an experiment file; see `run.load_experiment`."""
        return load_experiment(file, setting, list(overrides), folder)

    def prepare(self, experiment: Experiment, report: Report) -> None:
        """Make scene, objects and policies."""
        del report  # the stages show their own progress
        prepare_victims(experiment)

    def inputs(self, experiment: Experiment, cell: Cell) -> dict[str, Any]:
        """See `cell_inputs`."""
        return cell_inputs(experiment, cell)

    def run(self, experiment: Experiment, cell: Cell, folder: Path, report: Report) -> dict[str, Any]:
        """See `run_cell`."""
        return run_cell(experiment, cell, folder, report)

    def search(self, experiment: Experiment, cell: Cell, folder: Path, report: Report) -> None:
        """See `search_cell`."""
        search_cell(experiment, cell, folder, report)

    def finished(self, experiment: Experiment, cell: Cell) -> dict[str, Any] | None:
        """The cell of the stage deploy, if that is of these settings."""
        file = experiment.stage_folder("deploy") / f"{cell.name}.cell.json"
        if not file.exists() or not is_current(stages_of(experiment), experiment.folder, "deploy"):
            return None
        data: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return data

    def runs_alone(self, experiment: Experiment) -> bool:
        """Where a server steps one world at a time, or live nodes measure time."""
        return experiment.traits.exclusive or experiment.config.deploy.live

    def needed_settings(self, experiment: Experiment) -> dict[str, Any]:
        """Settings of capture, scene, object and policy."""
        return {stage.name: stage.settings for stage in stages_of(experiment) if stage.name in NEEDED}

    def draw_maps(
        self, experiment: Experiment, cell: Cell, number: int, folder: Path, report: Report
    ) -> list[Path]:
        """See `draw_maps`."""
        return draw_maps(experiment, cell, number, folder, report)

    def judges(self, experiment: Experiment) -> bool:
        """Where attacks are searched in a learned scene."""
        return not over_the_world(experiment)

    def predicts(self, experiment: Experiment) -> bool:
        """Where objects stay where they were placed by hand: a prediction composes them into pictures there."""
        return self.judges(experiment) and not isinstance(experiment.config.space, PlacesConfig)

    def policy_of(self, experiment: Experiment, cell: Cell) -> tuple[Any, tuple[float, ...]]:
        """See `fidelity.policy_of`."""
        return fidelity.policy_of(experiment, cell)

    def held_out(self, experiment: Experiment, cell: Cell) -> Pictures:
        """See `fidelity.held_out`."""
        del cell  # views about all paths
        return fidelity.held_out(experiment)

    def driven(self, experiment: Experiment, cell: Cell, folder: Path, bag: Path | None = None) -> Pictures:
        """See `fidelity.driven`."""
        return fidelity.driven(experiment, cell, self._clean(experiment, cell, folder), bag)

    def lacks(self, experiment: Experiment, cell: Cell, folder: Path) -> str:
        """See `fidelity.lacks`."""
        return fidelity.lacks(experiment, cell, folder, self._clean(experiment, cell, folder))

    def attacked(self, experiment: Experiment, cell: Cell, folder: Path) -> Pictures:
        """See `fidelity.attacked`."""
        return fidelity.attacked(experiment, cell, folder, self._clean(experiment, cell, folder))

    def loop(self, experiment: Experiment, cell: Cell, folder: Path) -> Loop:
        """See `fidelity.loop`."""
        return fidelity.loop(experiment, cell, folder)

    def _clean(self, experiment: Experiment, cell: Cell, folder: Path) -> Path:
        return clean_folder(experiment, cell, folder) if experiment.config.deploy.live else folder
