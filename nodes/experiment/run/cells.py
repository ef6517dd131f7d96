"""One entry of the transfer table, from the search to the deployed drive and its film; finished parts are not repeated."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from advnerf_core.attack.spaces.space import Space
from advnerf_core.files import write_atomically
from advnerf_core.policies.load import is_code, policy_files
from advnerf_core.report.conditions import NONE
from hardware.worlds.world import World
from nodes.experiment.engine.artefact import REFERENCE, VICTIM, Artefact, ReferenceBuild, write_artefact
from nodes.experiment.engine.stages import Stage, keep_stages, outdated
from nodes.experiment.plan.cell import SEARCHED_SHARE, Cell
from nodes.experiment.plan.space_config import PlacesConfig
from nodes.experiment.plan.victims import RETRAINED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import VictimUnknownError, given_in, given_victim
from nodes.experiment.show.spaces import make_space, over_the_world
from nodes.experiment.steps.attack import surrogate_part
from nodes.experiment.steps.deploy import cell_data
from nodes.experiment.steps.films import film_cell
from nodes.experiment.steps.frozen import check_frozen, freeze
from nodes.experiment.steps.keys import (
    clean_folder,
    drop_other_search,
    require_known,
    stages_needed,
    take_search,
)
from nodes.experiment.steps.live import LiveNodes
from nodes.experiment.steps.pipeline import stages_of, stages_of_cells
from nodes.runtime.progress import Report


class Bench:
    """Common resources of an experiment's cells while several are run one after the other: the open world, the space, the live nodes.

    Its scene, objects and policies are finished (``advnerf experiment run FILE --until policy``).
    """

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self._stack = ExitStack()

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *raised: object) -> None:
        self._stack.close()

    @cached_property
    def scene(self) -> World | None:
        """The open world; None if neither a search nor a drive uses it."""
        experiment = self.experiment
        if over_the_world(experiment):
            return self._stack.enter_context(experiment.open_world())
        if experiment.config.deploy.through == "world":
            return self._stack.enter_context(experiment.open_deployed_world())
        return None

    @cached_property
    def space(self) -> Space:
        """The search space."""
        return make_space(self.experiment, self.scene if over_the_world(self.experiment) else None)

    @cached_property
    def deployed_in(self) -> World | LiveNodes | None:
        """The open world, or the live nodes; None if nothing is deployed."""
        if self.experiment.config.deploy.live:
            return self._stack.enter_context(LiveNodes(self.experiment))
        return None if self.experiment.config.deploy.through == "nothing" else self.scene


def run_cell(
    experiment: Experiment,
    cell: Cell,
    folder: Path,
    report: Report,
    bench: Bench | None = None,
    control_m: Sequence[float] = (),
) -> dict[str, Any]:
    """Search, drive in both domains, and film; resumes from the content of ``folder``.

    Args:
        experiment: Experiment with finished scene, objects and policies (``advnerf experiment run FILE --until policy``).
        folder: Folder of this cell, for search state, attack file, drives and film.
        bench: Common resources of cells; None makes them.
        control_m: Total CTE of the deployed drives without attack [m], if it was driven already; see `worker.Job`.

    Returns:
        The cell as JSON data: see `deploy.cell_data`.

    Raises:
        NoSuchCellError: The experiment has no such drive, victim or method.
        FrozenChangedError: The scene, a victim or a place changed since the search.
    """
    require_known(experiment, cell)
    with Bench(experiment) if bench is None else nullcontext(bench) as shared:
        clean = search_cell(experiment, cell, folder, report, shared)
        check_frozen(experiment, cell, folder)
        tell = partial(report, SEARCHED_SHARE)
        tell("driving")
        driven = clean if cell.method == NONE else folder
        data = cell_data(experiment, shared.space, shared.deployed_in, cell, driven, clean, tell, control_m)
        if shared.deployed_in is None or "not_driven_live" in data:
            return data
        film = film_cell(experiment, shared.scene, shared.space, cell, folder, driven)
        # Relative to the folder of all cells.
        return {**data, "extra": {**data["extra"], "clip": f"{film.parent.name}/{film.name}"}}


def search_cell(
    experiment: Experiment, cell: Cell, folder: Path, report: Report, bench: Bench | None = None
) -> Path:
    """The part of `run_cell` without deployment: search and drive in the surrogate; returns the folder of the same drive without attack.

    A search in ``folder`` that was made of other inputs is made anew.

    Raises:
        NoSuchCellError: The experiment has no such drive, victim or method.
    """
    require_known(experiment, cell)
    clean = clean_folder(experiment, cell, folder)
    drop_other_search(experiment, cell, folder)
    freeze(experiment, cell, folder)
    with Bench(experiment) if bench is None else nullcontext(bench) as shared:
        take_search(experiment, cell.clean, clean)
        surrogate_part(experiment, shared.space, cell.clean, clean, report)
        if cell.method == NONE:
            return clean
        take_search(experiment, cell, folder)
        surrogate_part(experiment, shared.space, cell, folder, report)
    return clean


def keep_build(experiment: Experiment, reference: ReferenceBuild) -> list[Path]:
    """Copy scene, objects and policies into a reference build, without files that only their training reads; returns the new folders there."""
    return keep_stages(_needed_stages(experiment), experiment.folder, reference) + [
        found
        for victim, spec in given_in(experiment.config).items()
        if not is_code(spec) and (found := _keep_victim(experiment, victim, Path(spec), reference))
    ]


def _keep_victim(experiment: Experiment, victim: str, file: Path, reference: ReferenceBuild) -> Path | None:
    """Copy the files of an existing policy into a reference build, as it was last looked at; None if it was there, or has changed since."""
    try:
        sha256 = given_victim(experiment, victim).sha256
    except VictimUnknownError:
        return None
    with TemporaryDirectory() as work:
        for name, content in policy_files(file).items():
            write_atomically(Path(work) / name, content)
        write_artefact(Path(work), Artefact(sha256, sha256, 0.0, {"policy": file.name}))
        return reference.keep(VICTIM, sha256, Path(work))


def needed_settings(experiment: Experiment) -> dict[str, Any]:
    """Settings of the stages that cells need, by name: two experiments in one run folder must agree on them."""
    return {stage.name: stage.settings for stage in _needed_stages(experiment)}


def _needed_stages(experiment: Experiment) -> list[Stage]:
    names = {
        name for victim in experiment.config.attacked for name in stages_needed(experiment.config, victim)
    }
    return [stage for stage in stages_of(experiment) if stage.name in names]


def outdated_stages(experiment: Experiment, victim: str) -> list[str]:
    """Stages in the run folder that a victim's cells need, and that the next run makes anew, as settings or the user's files have changed."""
    needed = {*stages_needed(experiment.config, victim), *(("retrain",) if victim == RETRAINED else ())}
    found = outdated(stages_of_cells(experiment), experiment.folder, REFERENCE)
    return [name for name in found if name in needed]


def runs_alone(experiment: Experiment) -> bool:
    """Whether a cell needs the machine for itself: live nodes measure time, and a server steps one world at a time."""
    exclusive = experiment.known_deployed.traits.exclusive or experiment.traits.exclusive
    return exclusive or experiment.config.deploy.live


def has_learned_scene(experiment: Experiment) -> bool:
    """Whether attacks are searched in a learned scene, which the fidelity gate judges."""
    return not over_the_world(experiment)


def is_predictable(experiment: Experiment) -> bool:
    """Whether transfer can be predicted: a prediction composes objects at given places into pictures."""
    return has_learned_scene(experiment) and not isinstance(experiment.config.space, PlacesConfig)
