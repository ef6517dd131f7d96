"""What a cell depends on, by which it is known whether it is done; and where what its methods share is kept."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from advnerf_core.attack.methods import METHODS, black_box_methods, method_digest, require_method
from advnerf_core.attack.objectives import name_objective
from advnerf_core.plugins import PluginError
from advnerf_core.policies.policy_file import policy_sha256
from advnerf_core.report.conditions import EMPTY, NONE
from nodes.experiment.engine.artefact import digests_in, hash_of
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.space_config import FaceConfig
from nodes.experiment.plan.victims import RETRAINED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import given, given_in, victim_sha256, victim_spec
from nodes.experiment.steps import bake
from nodes.runtime.errors import RuntimeFault

# The stages that cells need of their experiment; what comes after is the cells themselves.
NEEDED = ("capture", "scene", "policy", "object")
# As of a stage (`run.VERSIONS`): raised when what a cell finds changes with the same settings.
VERSION = 4  # 4: textures are rounded to half precision before they are driven past
# What a cell does not depend on: which others there are, how much memory may be used, and what is told of the world elsewhere.
_FREE: Mapping[str, bool | set[str]] = {
    "name": True,
    "scenarios": True,
    "retrain": True,
    "gate": True,
    "victims": True,
    "reference": True,
    "world": True,
    "attack": {"seeds", "methods", "cache_mib"},
    "measure": {"no_object"},
    "deploy": {"laps", "empty_scene", "ready_timeout_s"},
}


# What a drive without attack does not depend on besides.
_SEARCHED_WITH = (
    "objective",
    "evaluations",
    "horizon",
    "learning_rate",
    "cem_population",
    "time_batch",
    "robustness",
)


class CellError(RuntimeFault):
    """A cell was asked for that this experiment does not have."""


def cell_inputs(experiment: Experiment, cell: Cell) -> dict[str, Any]:
    """What a cell depends on: the resolved world (of a server, not its address), settings, and what the stages before it wrote.

    Raises:
        CellError: No such drive, victim or method.
    """
    require_known(experiment, cell)
    inputs = registered_settings(experiment)
    if not cell.searched:
        for key in _SEARCHED_WITH:
            inputs["config"]["attack"].pop(key, None)
    stages = [name for name in NEEDED if name != "policy" or cell.victim not in given_in(experiment.config)]
    kept = {name: digest for name, digest in experiment.kept.items() if name in stages}
    inputs["stages"] = {**kept, **digests_in(experiment.folder, stages)}
    if cell.victim in given_in(experiment.config):
        inputs["config"].pop("policy")
        return {**inputs, "victim": victim_sha256(experiment, cell.victim)}
    if cell.victim != RETRAINED:
        return inputs
    file = Path(victim_spec(experiment, cell.victim))
    return {**inputs, "victim": policy_sha256(file) if file.exists() else None}


def registered_settings(experiment: Experiment) -> dict[str, Any]:
    """Settings that all cells of an experiment depend on, known before any stage is run: what a registration fixes."""
    config = experiment.config.model_dump(mode="json", exclude=_FREE)
    config["policy"] = experiment.config.policy.key()
    if given_in(experiment.config):
        config["view"] = experiment.view_settings
    name_objective(config["attack"])
    return {
        "version": VERSION,
        "bake": bake.VERSION,
        "config": config,
        "world": experiment.world_settings,
        **(
            {} if experiment.config.deploy.world is None else {"deployed_world": experiment.deployed_settings}
        ),
    }


def settings_hash(experiment: Experiment, cell: Cell) -> str:
    """The key of a cell: a hash of everything that its result depends on; a change of it makes the cell run again."""
    named = {
        "scenario": cell.scenario,
        "victim": cell.victim,
        "method": cell.method,
        "seed": cell.seed,
        "inputs": cell_inputs(experiment, cell),
    }
    if code := method_digest(cell.code):
        named["code"] = code
    # Through JSON, so that tuples and lists, or paths that were not turned into text, cannot change the hash between processes.
    return hash_of(json.loads(json.dumps(named, default=str)))


def require_known(experiment: Experiment, cell: Cell) -> None:
    """Refuse a cell that there cannot be.

    Raises:
        CellError: No such drive, victim or method.
    """
    retrained = [] if experiment.config.retrain is None else [RETRAINED]
    known: tuple[tuple[str, str, Sequence[str]], ...] = (
        ("scenario", cell.scenario, experiment.config.scenarios),
        ("victim", cell.victim, [*experiment.config.attacked, *retrained]),
    )
    for what, value, choices in known:
        if value not in choices:
            raise CellError(f"expected a {what} of {', '.join(choices)}, got {value!r}")
    if cell.method == EMPTY and isinstance(experiment.config.space, FaceConfig):
        raise CellError(
            "expected the control empty only where objects are attacked; a panel of the room was photographed with its scene"
        )
    if cell.searched:
        try:
            require_method(cell.code)
        except PluginError as error:
            raise CellError(str(error)) from None
    _require_gradient(experiment, cell)


def _require_gradient(experiment: Experiment, cell: Cell) -> None:
    """A built-in method that needs a gradient cannot attack a black box; users' methods are asked when they search."""
    method = METHODS.get(cell.code)
    if method is None or not method.needs_gradient or cell.victim not in given_in(experiment.config):
        return
    if not given(experiment)[cell.victim].declared.differentiable:
        raise CellError(
            f"expected methods that need no gradient against victim {cell.victim}, which declares that it has none, got {cell.method}; set "
            f"attack.methods to some of {', '.join(black_box_methods())}"
        )


def clean_folder(experiment: Experiment, cell: Cell, folder: Path) -> Path:
    """Where the drives without attack of a cell go, which belong to all methods: beside the cells' folders, named by what they depend on."""
    inputs = hash_of(cell_inputs(experiment, cell.clean))
    return folder.parent / "shared" / f"{experiment.config.name}_{cell.clean.name}_{inputs[:12]}"


def driven_folder(experiment: Experiment, cell: Cell) -> Path:
    """Where the experiment itself has the drives of a cell: those without attack are shared by its methods."""
    folder = experiment.cell_folder(cell)
    return clean_folder(experiment, cell, folder) if cell.method == NONE else folder
