"""Keys of cells, which decide whether they are finished; their files, and the folders and searches that cells share."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from advnerf_core.attack.methods import METHODS, black_box_methods, load_method, method_digest, require_method
from advnerf_core.attack.objectives import OBJECTIVES, ON_THE_PATH, load_objective, objective_key
from advnerf_core.files import write_atomically
from advnerf_core.plugins import PluginError, name_in_results
from advnerf_core.report.conditions import EMPTY, NONE
from nodes.experiment.engine.artefact import Settings, digests_in, has_key, hash_of, write_key
from nodes.experiment.engine.run_folder import ATTACK, SEARCHED
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.config import POLICY, ExperimentConfig
from nodes.experiment.plan.object_kinds import files_of
from nodes.experiment.plan.sections import NETWORK
from nodes.experiment.plan.victims import NAIVE, RETRAINED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.faces import has_face
from nodes.experiment.show.given import given_in, given_victim, victim_sha256, victim_spec
from nodes.experiment.show.spaces import named_objects
from nodes.experiment.steps import bake
from nodes.runtime.errors import RuntimeFault

_SEARCH_KEY = "search_key.json"
# Like a stage's version (`pipeline.VERSIONS`): raised when the result of a cell changes with the same settings.
VERSION = 5  # 5: gradients are followed in steps of 0.3 instead of 0.1
# Settings that a cell does not depend on: other cells, memory limits, and values that are separate inputs below.
FREE: Mapping[str, Any] = {
    "name": True,
    "paths": True,
    "retrain": True,
    "gate": True,
    "victims": True,
    "reference": True,
    "over": True,
    "contrasts": True,
    "claims": True,
    "run_folder": True,
    "maps": True,
    "world": True,
    "view": True,
    "policy": NETWORK,
    "attack": {"objective", "cache_mib", "together"},
    "deploy": {"world", "laps", "empty_scene", "ready_timeout_s"},
}
# Further settings that a drive without attack does not depend on.
_SEARCHED_WITH = {
    *("evaluations", "horizon", "learning_rate", "population", "time_batch", "robustness"),
    *("step", "sigma", "probes", "warm_pairs", "options", "start_poses", "goals"),
}


class NoSuchCellError(RuntimeFault):
    """The experiment has no such cell."""


def stages_needed(config: ExperimentConfig, victim: str) -> list[str]:
    """Stages that the cells of a victim need; later ones are the cells themselves."""
    return ["capture", "scene", config.policy_stage(victim), "object"]


def cell_settings(experiment: Experiment, cell: Cell, deployed: bool = True) -> Settings:
    """Settings that a cell depends on: the resolved world (without a server's address), settings, and the outputs of the earlier stages.

    Args:
        deployed: Whether it is deployed too; else the search alone counts, which depends neither on the section ``deploy`` nor on world settings
            that change only how its own car moves (`Traits.unseen`).

    Raises:
        NoSuchCellError: The experiment has no such drive, victim or method.
    """
    require_known(experiment, cell)
    free, given_victims = dict(FREE), given_in(experiment.config)
    inputs: dict[str, Any] = {
        "scenario": cell.scenario,
        "victim": cell.victim,
        "method": cell.method,
        "seed": cell.seed,
        "code": method_digest(cell.code),
    }
    config = experiment.config.training(cell.victim)
    stages = stages_needed(experiment.config, cell.victim)
    if cell.searched:
        inputs["objective"] = objective_key(config.attack.objective)
    else:
        free["attack"] = FREE["attack"] | _SEARCHED_WITH
    if cell.victim in given_victims:
        free["policy"] = True
        stages.remove(POLICY)
    else:
        inputs["architecture"] = config.policy.network.described()
    trained = experiment.config.trained.get(cell.victim)
    # Names of the default victims say it; the stage stores the weights by it, whatever the victim is called.
    if trained is not None and trained.textures != ("none" if cell.victim == NAIVE else "random"):
        inputs["textures"] = trained.textures
    if cell.victim in (*given_victims, RETRAINED):
        inputs["policy_sha256"] = _policy_sha256(experiment, cell.victim)
    if not deployed:
        # Objects are searched in the same way for any presentation to the car.
        free |= (
            {"deploy": True} if has_face(experiment) else {"deploy": True, "carrier": {"kind", "training"}}
        )
    if experiment.given_scene is not None:  # for which no stage makes them
        inputs["geometry"] = hash_of([each.sha256 for each in named_objects(experiment)])
    kept = {name: digest for name, digest in experiment.kept.items() if name in stages}
    inputs["stages"] = {**kept, **digests_in(experiment.folder, stages)}
    made = Settings.of(config, None, free, **inputs, **_common_inputs(experiment, deployed))
    return made.noting(
        **_object_files(config)
    )  # a registration has them, which cannot know the digests of stages


def _policy_sha256(experiment: Experiment, victim: str) -> str | None:
    """Content hash of a policy that the stage policy does not make; None for one that is not retrained yet."""
    if victim == RETRAINED and not Path(victim_spec(experiment, victim)).exists():
        return None
    return victim_sha256(experiment, victim)


def _common_inputs(experiment: Experiment, deployed: bool = True) -> dict[str, Any]:
    """Inputs of all cells of an experiment: versions, worlds and view."""
    config = experiment.config
    # Objectives on the path judge states alone; others may use the car's body.
    seen = not deployed and config.attack.objective in ON_THE_PATH
    return {
        "version": VERSION,
        "bake": bake.VERSION if experiment.given_scene is None else bake.OWN_VERSION,
        "world": experiment.seen_settings if seen else experiment.world_settings,
        "deployed_world": experiment.known_deployed.settings if deployed and config.deploy.world else None,
        "view": experiment.view_settings,
        **({"graph_sha256": hash_of(experiment.graph)} if deployed and config.deploy.live else {}),
    }


def registered_settings(experiment: Experiment) -> Settings:
    """Settings that all cells of an experiment depend on, known before any stage is run: the content of a registration."""
    config = experiment.config
    code = {
        "objective": objective_key(config.attack.objective),
        "architecture": config.policy.network.described(),
    }
    own = {"recipes": found} if (found := own_recipes(config)) else {}
    return Settings.of(config, None, FREE, **code, **own, **_common_inputs(experiment))


def pinned_code(config: ExperimentConfig) -> dict[str, dict[str, str]]:
    """What a registration notes beside `registered_settings`, whose key older registrations have: object files, and methods of the user's own."""
    digests = {name_in_results(each): method_digest(each) for each in config.methods}
    own = {name: digest for name, digest in digests.items() if digest}
    return {**_object_files(config), **({"methods": own} if own else {})}


def _object_files(config: ExperimentConfig) -> dict[str, dict[str, str]]:
    """SHA-256 of each object file by its name, as an entry ``files``; none if there are only built-in objects."""
    found = files_of([each.kind for each in config.objects])
    return {"files": found} if found else {}


def own_recipes(config: ExperimentConfig) -> dict[str, dict[str, Any]]:
    """Training settings of the victims with a recipe of their own, as JSON data."""
    return {
        name: config.training(name).policy.recipe
        for name in config.trained
        if config.policy_stage(name) != POLICY
    }


def settings_hash(experiment: Experiment, cell: Cell) -> str:
    """The key of a cell: a hash of everything that its result depends on; a change makes the cell run again."""
    return cell_settings(experiment, cell).key


def require_known(experiment: Experiment, cell: Cell) -> None:
    """Raise for an impossible cell.

    Raises:
        NoSuchCellError: The experiment has no such drive, victim or method.
    """
    retrained = [] if experiment.config.retrain is None else [RETRAINED]
    known: tuple[tuple[str, str, Sequence[str]], ...] = (
        ("path", cell.scenario, experiment.config.paths),
        ("victim", cell.victim, [*experiment.config.attacked, *retrained]),
    )
    for what, value, choices in known:
        if value not in choices:
            raise NoSuchCellError(f"expected a {what} of {', '.join(choices)}, got {value!r}")
    if cell.method == EMPTY and has_face(experiment):
        raise NoSuchCellError(
            "expected the control empty only where objects are attacked; a panel of the room was photographed with its scene"
        )
    if cell.searched:
        if not experiment.config.objects and not has_face(experiment):
            raise NoSuchCellError(
                "expected objects, whose colours or places are searched, got none; list some in the section objects"
            )
        try:
            require_method(cell.code)
        except PluginError as error:
            raise NoSuchCellError(str(error)) from None
    _require_gradient(experiment, cell)


def require_searchable(experiment: Experiment, cells: Sequence[Cell]) -> None:
    """Load the user's own objective and method of each cell, before anything is made for it, and check that its victim has the gradient that the method needs.

    Raises:
        NoSuchCellError: Code of a user's own cannot be loaded or is of another kind, the world lacks what the objective needs, or a black box would
            be attacked by a gradient; with the file.
    """
    for cell in cells:
        inside = experiment.of(cell)
        try:
            _require_objective(inside)
            if cell.searched and cell.code not in METHODS:
                load_method(cell.code)
        except PluginError as error:
            raise NoSuchCellError(f"{experiment.file}: {error}") from None
        _require_gradient(inside, cell)


def _require_objective(experiment: Experiment) -> None:
    objective = experiment.config.attack.objective  # a built-in one was checked when the file was read
    if objective not in OBJECTIVES and load_objective(objective).needs_solids and experiment.solids is None:
        raise NoSuchCellError(f"{experiment.file}: {without_solids(experiment)}")


def without_solids(experiment: Experiment) -> str:
    """What is wrong with an objective that needs solids in a world without any."""
    return (
        f"attack.objective: expected an objective that needs no solids, as the world {experiment.named_world.kind} does not say what its car can "
        f"hit, got {experiment.config.attack.objective}; choose cte, or add solids to the world (docs/worlds.md)"
    )


def _require_gradient(experiment: Experiment, cell: Cell) -> None:
    """Check that a built-in method with a gradient does not attack a black box; users' methods are checked when they search."""
    method = METHODS.get(cell.code)
    if method is None or not method.needs_gradient or cell.victim not in given_in(experiment.config):
        return
    if not given_victim(experiment, cell.victim).declared.differentiable:
        raise NoSuchCellError(
            f"{experiment.file}: expected methods that need no gradient against victim {cell.victim}, which declares that it has none, got {cell.method}; set "
            f"over.method to some of {', '.join(black_box_methods())}"
        )


def clean_folder(experiment: Experiment, cell: Cell, folder: Path) -> Path:
    """Folder of a cell's drives without attack, which all methods share: beside the cells' folders, named by their key."""
    inputs = cell_settings(experiment, cell.clean).key
    return folder.parent / "shared" / f"{experiment.config.name}_{cell.clean.name}_{inputs[:12]}"


def driven_folder(experiment: Experiment, cell: Cell) -> Path:
    """Folder of a cell's drives in the experiment; its methods share the drives without attack."""
    folder = experiment.cell_folder(cell)
    return clean_folder(experiment, cell, folder) if cell.method == NONE else folder


def search_key(experiment: Experiment, cell: Cell) -> str:
    """Hash of everything that a search, and the drives in the surrogate past its attack, depend on."""
    return cell_settings(experiment, cell, deployed=False).key


def drop_other_search(experiment: Experiment, cell: Cell, folder: Path) -> None:
    """Remove a cell's folder if its search was of another policy, scene, place or settings: its results are not this cell's."""
    file = folder / _SEARCH_KEY
    if file.exists() and not has_key(file, search_key(experiment, cell)):
        shutil.rmtree(folder)


def take_search(experiment: Experiment, cell: Cell, folder: Path) -> Path | None:
    """Copy the search of a cell whose folder is beside this one's if it is the same, and return that folder.

    Cells that differ only in their deployment have one search. Nothing happens if this cell has begun its own. The stages before the
    cells are finished.
    """
    settings = cell_settings(experiment, cell, deployed=False)
    if has_key(folder / _SEARCH_KEY, settings.key):
        return None
    beside = sorted(file for file in folder.parent.glob(f"*/{_SEARCH_KEY}") if file.parent != folder)
    same = (file.parent for file in beside if has_key(file, settings.key))
    if (found := next((each for each in same if (each / SEARCHED).exists()), None)) is not None:
        # The drives come last: without them the search counts as unfinished.
        for name in (ATTACK, SEARCHED):
            if (found / name).exists():
                write_atomically(folder / name, (found / name).read_bytes())
    write_key(folder / _SEARCH_KEY, settings.key, settings)
    return found
