"""Which code runs the cells of a scenario: a module per kind, known by name or named by whoever has a deployment scene of their own.

A module of cells has one function that it must have, and may have others::

    def run_cell(experiment, scenario, victim, method, seed, folder, report) -> dict      # a cell, see report/cells.py
    def search_cell(experiment, scenario, victim, method, seed, folder, report) -> None   # its part that may run beside others
    def draw_maps(experiment, scenario, victim, seed, method, number, folder, report) -> list[Path]   # pictures about what a finished cell found
    def load_experiment(file, setting, overrides, folder) -> experiment
    def prepare(experiment, report) -> None                                               # what all its cells need
    def cell_inputs(experiment, scenario, victim, method, seed) -> dict                   # what the result depends on, JSON
    def runs_alone(experiment) -> bool   # whether run_cell needs the machine, or the one server, for itself: such cells run after all others
    def has_learned_scene(experiment) -> bool   # whether there is a learned scene for the gate of the package's module fidelity; else there is
    def predictable(experiment) -> bool         # whether transfer can be predicted where the gate holds; else it can
    TAKEN_FROM = "deploy"    # stage of the experiment in whose folder such cells may be finished already

``method`` is ``none``, or a method as `advnerf_core.attack.methods.load_method` takes it; `method_name` gives its name for files.
What a module lacks comes from the package it is in (``run.load_experiment``, ``run.run_experiment``), as the experiments of this project have it.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from advnerf_core.attack.methods import method_digest, method_name
from nodes.experiment.stages import hash_of, is_current, read_record
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import Report

KINDS = {"world": "nodes.experiment.cells"}
RunCell = Callable[[Any, str, str, str, int, Path, Report], dict[str, Any]]
# The stages that a cell needs of its experiment; what comes after is the cell itself.
_NEEDED = ("capture", "scene", "policy", "object", "objects")
_LAST_NEEDED = "object"


@dataclass(frozen=True)
class Kind:
    """How the cells of one kind of scenario are run.

    Attributes:
        name: As in the campaign file.
        module: The module of cells.
    """

    name: str
    module: Any

    def runs_alone(self, experiment: Any) -> bool:
        """Whether `run_cell` drives a live graph and so runs alone."""
        alone = getattr(self.module, "runs_alone", None)
        return alone is not None and bool(alone(experiment))

    def predicts(self, experiment: Any) -> bool:
        """Whether transfer can be predicted from pictures."""
        predictable = getattr(self.module, "predictable", None)
        return self.judges(experiment) and (predictable is None or bool(predictable(experiment)))

    def judges(self, experiment: Any) -> bool:
        """Whether there is a learned scene that the fidelity gate judges."""
        learned = getattr(self.module, "has_learned_scene", None)
        return self.fidelity is not None and (learned is None or bool(learned(experiment)))

    @property
    def run_cell(self) -> RunCell:
        """Runs one cell to its end; goes on where an earlier run of it was stopped."""
        found: RunCell = self.module.run_cell
        return found

    @property
    def search_cell(self) -> Callable[..., None] | None:
        """The part of a live cell that may run beside others."""
        found: Callable[..., None] | None = getattr(self.module, "search_cell", None)
        return found

    def finished(
        self, experiment: Any, scenario: str, victim: str, method: str, seed: int
    ) -> dict[str, Any] | None:
        """The cell as the experiment itself has run it, with these settings; None where it has not, or where the kind keeps none."""
        stage = getattr(self.module, "TAKEN_FROM", "")
        file = experiment.folder / stage / f"{scenario}_{victim}_{method_name(method)}_{seed}.cell.json"
        if (
            not stage
            or not file.exists()
            or not is_current(self._run_module().stages_of(experiment), experiment.folder, stage)
        ):
            return None
        data: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return data

    @property
    def fidelity(self) -> Any:
        """The module with the pictures of the fidelity gate, beside the module of cells; None where there is none."""
        package = getattr(self.module, "__package__", "")
        name = f"{package}.fidelity"
        return importlib.import_module(name) if package and find_spec(name) is not None else None

    def load(self, file: Path, setting: str, overrides: Sequence[str], folder: Path) -> Any:
        """Read the experiment."""
        load = getattr(self.module, "load_experiment", None) or self._run_module().load_experiment
        return load(file, setting, list(overrides), folder)

    def prepare(self, experiment: Any, report: Report) -> None:
        """Make what all cells of the experiment need and is not there yet."""
        if prepare := getattr(self.module, "prepare", None):
            prepare(experiment, report)
        else:
            self._run_module().run_experiment(
                experiment, until=getattr(self.module, "PREPARED_AT", _LAST_NEEDED)
            )

    def needed_settings(self, experiment: Any) -> dict[str, Any]:
        """Settings of the stages that a cell needs, by name; none where the kind's package has no stages."""
        package = getattr(self.module, "__package__", "")
        if not package or find_spec(f"{package}.run") is None or not hasattr(self._run_module(), "stages_of"):
            return {}
        stages = self._run_module().stages_of(experiment)
        return {stage.name: stage.settings for stage in stages if stage.name in _NEEDED}

    def inputs(self, experiment: Any, scenario: str, victim: str, method: str, seed: int) -> dict[str, Any]:
        """What a cell's result depends on."""
        if inputs := getattr(self.module, "cell_inputs", None):
            found: dict[str, Any] = inputs(experiment, scenario, victim, method, seed)
            return found
        config = experiment.config.model_dump(mode="json")
        for section in config.values():  # which other seeds there are changes nothing
            if isinstance(section, dict):
                section.pop("seeds", None)
        return {"config": config, "stages": stage_digests(experiment.folder)}

    def _run_module(self) -> Any:
        return importlib.import_module(f"{self.module.__package__}.run")


def load_kind(name: str) -> Kind:
    """The kind of a scenario.

    Raises:
        ConfigError: There is no such kind, or its module has no cells.
    """
    path = KINDS.get(name, name)
    try:
        known = find_spec(path) is not None
    except (ModuleNotFoundError, ValueError):
        known = False
    if not known:
        raise ConfigError(
            f"expected a kind of scenario ({', '.join(KINDS)}) or an importable module of cells, got {name!r}; install it, or correct kind"
        )
    module = importlib.import_module(path)
    if not callable(getattr(module, "run_cell", None)):
        raise ConfigError(
            f"expected a function run_cell in {path}, got none; see nodes/experiment/campaign/kinds.py"
        )
    return Kind(name, module)


def stage_digests(folder: Path) -> dict[str, str]:
    """Digests of what the finished stages of a run folder wrote that cells need."""
    records = {name: read_record(folder / name) for name in _NEEDED}
    return {name: record.digest for name, record in records.items() if record is not None and record.digest}


def settings_hash(kind: Kind, experiment: Any, scenario: str, victim: str, method: str, seed: int) -> str:
    """Hash of everything that the result of a cell depends on; a change of it makes the cell run again."""
    inputs = kind.inputs(experiment, scenario, victim, method, seed)
    named = {
        "scenario": scenario,
        "victim": victim,
        "method": method_name(method),
        "seed": seed,
        "inputs": inputs,
    }
    if code := method_digest(method):
        named["code"] = code
    # Through JSON, so that tuples and lists, or paths that a module forgot to turn into text, cannot change the hash between processes.
    return hash_of(json.loads(json.dumps(named, default=str)))
