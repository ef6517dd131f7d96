"""How cells are run: the contract of a kind of cells; `nodes.experiment.run.kinds` finds one by name."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from advnerf_core.attack.methods import method_digest
from nodes.experiment.engine.stage_record import hash_of
from nodes.experiment.plan.cell import Cell
from nodes.runtime.errors import RuntimeFault
from nodes.runtime.progress import Report

if TYPE_CHECKING:
    import torch

    from advnerf_core.attack.adjoint import AttackProblem
    from advnerf_core.attack.transfer import AttackableScene
    from advnerf_core.driving.metrics import Horizon
    from advnerf_core.scene.fidelity import PicturePairs
    from nodes.experiment.engine.reference import ReferenceBuild

    Loop = tuple[AttackProblem, AttackableScene, torch.Tensor, Horizon]


class NoPicturesError(RuntimeFault):
    """Real and learned pictures were asked of a kind of cells that has none."""


class CellKind(ABC):
    """Runs cells of one kind. `nodes.experiment.run.cells.ExperimentCells` runs those of experiment files.

    ``experiment`` is whatever `load` returns; it has an attribute ``folder``, its run folder.

    Attributes:
        searches_apart: Whether `search` does a part of a cell that may run beside others.
        code: Hash of a user's code; empty for the kind that this project brings.
    """

    searches_apart: ClassVar[bool] = False
    code: str = ""

    @abstractmethod
    def load(self, file: Path, setting: str, overrides: Sequence[str], folder: Path) -> Any:
        """Read an experiment."""

    @abstractmethod
    def inputs(self, experiment: Any, cell: Cell) -> dict[str, Any]:
        """What the result of a cell depends on, as JSON data."""

    @abstractmethod
    def run(self, experiment: Any, cell: Cell, folder: Path, report: Report) -> dict[str, Any]:
        """Run a cell to its end, or on from where an earlier run of it was stopped; see `advnerf_core.report.cells`."""

    def prepare(self, experiment: Any, report: Report) -> None:
        """Make what all cells of the experiment need and is not there yet."""
        return

    def keep(self, experiment: Any, reference: ReferenceBuild) -> list[Path]:
        """Copy what cells of the experiment are run with into a reference build; returns the folders that are new there."""
        return []

    def search(self, experiment: Any, cell: Cell, folder: Path, report: Report) -> None:
        """The part of `run` that may run beside others."""
        return

    def hold(self, experiment: Any) -> AbstractContextManager[None]:
        """Keep open what cells of one experiment share, while several are run one after the other in this process."""
        return nullcontext()

    def runs_alone(self, experiment: Any) -> bool:
        """Whether `run` needs the machine, or the one server, for itself: such cells run after all others."""
        return False

    def needed_settings(self, experiment: Any) -> dict[str, Any]:
        """Settings of the stages that cells need, by name: two experiments in one run folder must agree on them."""
        return {}

    def registered_settings(self, experiment: Any) -> dict[str, Any] | None:
        """What a registration fixes of an experiment, known before any stage is run, as JSON data; None where it cannot be registered."""
        return None

    def draw_maps(self, experiment: Any, cell: Cell, number: int, folder: Path, report: Report) -> list[Path]:
        """Pictures about what a finished cell found; none where there is nothing to draw."""
        return []

    def judges(self, experiment: Any) -> bool:
        """Whether there is a learned scene that the fidelity gate judges; the methods below are called only then."""
        return False

    def predicts(self, experiment: Any) -> bool:
        """Whether transfer can be predicted from pictures."""
        return self.judges(experiment)

    def policy_of(self, experiment: Any, cell: Cell) -> tuple[Any, tuple[float, ...]]:
        """The victim of a cell and what it is told."""
        raise self._no_pictures()

    def held_out(self, experiment: Any, cell: Cell) -> PicturePairs:
        """Views that nothing was learned from, without an attack."""
        raise self._no_pictures()

    def driven(self, experiment: Any, cell: Cell, folder: Path, bag: Path | None = None) -> PicturePairs:
        """Views of the deployed drive without attack of a cell, or of a bag of one."""
        raise self._no_pictures()

    def lacks(self, experiment: Any, cell: Cell, folder: Path) -> str:
        """What a prediction still needs, in words; empty if all is there."""
        raise self._no_pictures()

    def attacked(self, experiment: Any, cell: Cell, folder: Path) -> PicturePairs:
        """The views of `driven` with what the finished search found."""
        raise self._no_pictures()

    def loop(self, experiment: Any, cell: Cell, folder: Path) -> Loop:
        """What a prediction drives: the problem, pictures with or without the attack, the deployed starts ``[S, n]`` and the horizon."""
        raise self._no_pictures()

    def _no_pictures(self) -> NoPicturesError:
        return NoPicturesError(
            f"expected cells with real and learned pictures, got {type(self).__name__}, which has none: no gate and no prediction"
        )


def settings_hash(kind: CellKind, experiment: Any, cell: Cell) -> str:
    """The key of a cell: a hash of everything that its result depends on; a change of it makes the cell run again."""
    named = {
        "scenario": cell.scenario,
        "victim": cell.victim,
        "method": cell.method,
        "seed": cell.seed,
        "inputs": kind.inputs(experiment, cell),
    }
    if code := method_digest(cell.code):
        named["code"] = code
    if kind.code:
        named["kind"] = kind.code
    # Through JSON, so that tuples and lists, or paths that were not turned into text, cannot change the hash between processes.
    return hash_of(json.loads(json.dumps(named, default=str)))
