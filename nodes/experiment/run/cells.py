"""One entry of the transfer table, from the search to the deployed drive and its film; a finished part is not done again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advnerf_core.attack.artifact import PLACES, load_attack
from advnerf_core.attack.spaces.space import Space
from advnerf_core.report.conditions import NONE
from hardware.worlds.world import World, traits_of
from nodes.experiment.engine.reference import ReferenceBuild
from nodes.experiment.engine.stages import keep_stages
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.space_config import PlacesConfig
from nodes.experiment.run.cell_kind import CellKind
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.spaces import make_space, over_the_world
from nodes.experiment.steps import fidelity, pose_maps
from nodes.experiment.steps.attack import surrogate_part
from nodes.experiment.steps.deploy import Deployer, ThroughNodes, ThroughWorld, cell_data
from nodes.experiment.steps.films import film_cell, kept_film, with_film
from nodes.experiment.steps.frozen import check_frozen, freeze
from nodes.experiment.steps.keys import (
    NEEDED,
    CellError,
    cell_inputs,
    clean_folder,
    registered_settings,
    require_known,
)
from nodes.experiment.steps.run import load_experiment, prepare_victims, stages_of
from nodes.experiment.steps.search_files import ATTACK
from nodes.experiment.steps.shared_search import take_search
from nodes.runtime.progress import Report

if TYPE_CHECKING:
    from advnerf_core.scene.fidelity import PicturePairs
    from nodes.experiment.run.cell_kind import Loop

_SEARCHED = 0.9  # share of a cell's work


class Bench:
    """What cells of one experiment share while several are run one after the other: the open world, the space, the deployer.

    Args:
        experiment: Its scene, objects and policies must be there (``advnerf experiment FILE --until policy``).
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
        """The open world; None where neither a search nor a drive looks at it."""
        experiment = self.experiment
        if over_the_world(experiment):
            return self._stack.enter_context(experiment.open_world())
        if experiment.config.deploy.through == "world":
            return self._stack.enter_context(experiment.open_deployed_world())
        return None

    @cached_property
    def space(self) -> Space:
        """What is searched."""
        return make_space(self.experiment, self.scene if over_the_world(self.experiment) else None)

    @cached_property
    def deployer(self) -> Deployer | None:
        """What drives; None where nothing is deployed."""
        if self.experiment.config.deploy.live:
            return ThroughNodes(self.experiment)
        if self.experiment.config.deploy.through == "nothing":
            return None
        assert self.scene is not None, "it is open where the world's own car drives"
        return ThroughWorld(self.experiment, self.scene)


def run_cell(
    experiment: Experiment, cell: Cell, folder: Path, report: Report, bench: Bench | None = None
) -> dict[str, Any]:
    """Search, drive in both domains, and film; goes on from what is in ``folder``.

    Args:
        experiment: Its scene, objects and policies must be there (``advnerf experiment FILE --until policy``).
        cell: Which.
        folder: Of this cell: search state, attack file, drives and film are kept here.
        report: Told the finished fraction.
        bench: What cells share; None makes one.

    Returns:
        The cell as JSON data: see `deploy.cell_data`.

    Raises:
        CellError: No such drive, victim or method.
        FrozenChangedError: The scene, a victim or a place changed since the search.
    """
    require_known(experiment, cell)
    with Bench(experiment) if bench is None else nullcontext(bench) as shared:
        clean = search_cell(experiment, cell, folder, report, shared)
        check_frozen(experiment, cell, folder)
        tell = partial(report, _SEARCHED)
        tell("driving")
        driven = clean if cell.method == NONE else folder
        data = cell_data(experiment, shared.space, shared.deployer, cell, driven, clean, tell)
        if shared.deployer is None or "not_driven_live" in data:
            return data
        film = kept_film(folder) or film_cell(
            experiment, shared.deployer.scene, shared.space, cell, folder, driven
        )
        return with_film(data, film)


def search_cell(
    experiment: Experiment, cell: Cell, folder: Path, report: Report, bench: Bench | None = None
) -> Path:
    """The part of `run_cell` that deploys nothing: search and drive in the surrogate.

    Returns:
        The folder of the same drive without attack.

    Raises:
        CellError: No such drive, victim or method.
    """
    require_known(experiment, cell)
    clean = clean_folder(experiment, cell, folder)
    freeze(experiment, cell, folder)
    with Bench(experiment) if bench is None else nullcontext(bench) as shared:
        take_search(experiment, cell.clean, clean)
        surrogate_part(experiment, shared.space, cell.clean, clean, report)
        if cell.method == NONE:
            return clean
        take_search(experiment, cell, folder)
        surrogate_part(experiment, shared.space, cell, folder, report)
    return clean


def draw_maps(experiment: Experiment, cell: Cell, number: int, folder: Path, report: Report) -> list[Path]:
    """Loss landscape and robustness map of a finished cell of places; none of a cell that moved nothing.

    Raises:
        CellError: There is no object of this number.
    """
    if not cell.searched or not isinstance(experiment.config.space, PlacesConfig):
        return []
    count = len(experiment.objects)
    if not 0 <= number < count:
        raise CellError(f"expected an object of 0 to {count - 1}, got {number}")
    attack = load_attack(folder / ATTACK)
    assert attack.space == PLACES, "the file was written by a cell of this experiment"
    return pose_maps.draw_maps(experiment, cell, attack, number, folder, report)


class ExperimentCells(CellKind):
    """Cells of experiment files; see `CellKind` for what each method does."""

    searches_apart = True

    def __init__(self) -> None:
        self._bench: Bench | None = None

    def _bench_of(self, experiment: Experiment) -> Bench | None:
        return self._bench if self._bench is not None and self._bench.experiment is experiment else None

    def load(self, file: Path, setting: str, overrides: Sequence[str], folder: Path) -> Experiment:
        """Read an experiment file; see `run.load_experiment`."""
        return load_experiment(file, setting, list(overrides), folder)

    def prepare(self, experiment: Experiment, report: Report) -> None:
        """Make scene, objects and policies."""
        del report  # the stages show their own progress
        prepare_victims(experiment)

    def keep(self, experiment: Experiment, reference: ReferenceBuild) -> list[Path]:
        """Scene, objects and policies, without what only their training read."""
        needed = [stage for stage in stages_of(experiment) if stage.name in NEEDED]
        return keep_stages(needed, experiment.folder, reference)

    def inputs(self, experiment: Experiment, cell: Cell) -> dict[str, Any]:
        """See `cell_inputs`."""
        return cell_inputs(experiment, cell)

    def run(self, experiment: Experiment, cell: Cell, folder: Path, report: Report) -> dict[str, Any]:
        """See `run_cell`."""
        return run_cell(experiment, cell, folder, report, self._bench_of(experiment))

    def search(self, experiment: Experiment, cell: Cell, folder: Path, report: Report) -> None:
        """See `search_cell`."""
        search_cell(experiment, cell, folder, report, self._bench_of(experiment))

    @contextmanager
    def hold(self, experiment: Experiment) -> Iterator[None]:
        """Keep world and space open."""
        with Bench(experiment) as bench:
            self._bench = bench
            try:
                yield
            finally:
                self._bench = None

    def runs_alone(self, experiment: Experiment) -> bool:
        """Where a server steps one world at a time, or live nodes measure time."""
        deployed = traits_of(experiment.deployed_world.make())
        return deployed.exclusive or experiment.traits.exclusive or experiment.config.deploy.live

    def needed_settings(self, experiment: Experiment) -> dict[str, Any]:
        """Settings of capture, scene, object and policy."""
        return {stage.name: stage.settings for stage in stages_of(experiment) if stage.name in NEEDED}

    def registered_settings(self, experiment: Experiment) -> dict[str, Any]:
        """See `keys.registered_settings`."""
        return registered_settings(experiment)

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

    def held_out(self, experiment: Experiment, cell: Cell) -> PicturePairs:
        """See `fidelity.held_out`."""
        del cell  # views about all paths
        return fidelity.held_out(experiment)

    def driven(
        self, experiment: Experiment, cell: Cell, folder: Path, bag: Path | None = None
    ) -> PicturePairs:
        """See `fidelity.driven`."""
        return fidelity.driven(experiment, cell, clean_folder(experiment, cell, folder), bag)

    def lacks(self, experiment: Experiment, cell: Cell, folder: Path) -> str:
        """See `fidelity.lacks`."""
        return fidelity.lacks(experiment, cell, folder, clean_folder(experiment, cell, folder))

    def attacked(self, experiment: Experiment, cell: Cell, folder: Path) -> PicturePairs:
        """See `fidelity.attacked`."""
        return fidelity.attacked(experiment, cell, folder, clean_folder(experiment, cell, folder))

    def loop(self, experiment: Experiment, cell: Cell, folder: Path) -> Loop:
        """See `fidelity.loop`."""
        return fidelity.loop(experiment, cell, folder, clean_folder(experiment, cell, folder))
