"""Running a request: the method that was asked for, resumable, ending in an attack file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from advnerf_core.attack.artifact import save_attack
from advnerf_core.attack.methods import Method, SearchRun, SearchSettings, load_method
from advnerf_core.attack.objectives import load_objective
from advnerf_core.attack.on_device import all_on_chosen_device, on_chosen_device
from advnerf_core.attack.search.record import Evaluation, OnEvaluation, SearchResult
from advnerf_core.attack.search.together import gradient_attacks
from advnerf_core.attack.spaces import places
from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically, write_json
from advnerf_core.places import require_utf8
from advnerf_core.plugins import name_in_results
from nodes.experiment.node.job import REQUEST, TOGETHER_STATE, is_begun
from nodes.experiment.node.poses import draw_found
from nodes.experiment.node.prepare import load_request, prepare, request_text, searched_cell
from nodes.experiment.plan.rules import check_options
from nodes.experiment.plan.space_config import MeshShapeConfig, PlacesConfig
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.victims import look_at_given
from nodes.experiment.steps.attack import Prepared, search_settings, telling
from nodes.experiment.steps.attack import attack_file as make_attack_file
from nodes.experiment.steps.keys import search_key
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import StageDisplay

_KEY = "settings_hash"  # of a curve: that of the search


def chosen_method(experiment: Experiment) -> tuple[Method, SearchSettings]:
    """The method of a request, loaded, and its settings.

    Raises:
        PluginError: The method's code cannot be loaded.
        MethodError: The method has no such options.
        ConfigError: The method cannot search the requested parameters.
    """
    config = experiment.config
    (reference,), (name,) = config.methods, config.method_names
    method = load_method(reference)
    if load_objective(config.attack.objective).needs_solids:
        raise ConfigError(
            f"attack.objective: expected an objective that needs no solids, as a room calibration does not say what the car can hit, got "
            f"{name_in_results(config.attack.objective)}; search for it in a world that does"
        )
    if isinstance(config.space, MeshShapeConfig) and not method.reads_scale:
        raise ConfigError(
            f"over.method: expected a method that searches shapes, such as random or gradient, got {name}"
        )
    if isinstance(config.space, PlacesConfig) and name not in places.METHODS:
        raise ConfigError(
            f"over.method: expected a method that searches places, {' or '.join(places.METHODS)}, got {name}"
        )
    check_options(config.methods, config.attack)
    return method, search_settings(experiment, method)


def search(
    prepared: Prepared, state_path: Path | None = None, on_evaluation: OnEvaluation | None = None
) -> SearchResult:
    """Search as requested; an exception from ``on_evaluation`` ends the search, which then resumes from its state file."""
    _, settings = chosen_method(prepared.experiment)
    run = SearchRun(prepared.seed, state_path, on_evaluation, prepared.settings_hash)
    with prepared.telling_unseen():
        return prepared.space.search(prepared.cell.code, on_chosen_device(prepared.problem), settings, run)


def planned_evaluations(prepared: Prepared) -> int:
    """Number of drives that the budget allows the method."""
    method, settings = chosen_method(prepared.experiment)
    return method.evaluations(prepared.problem, settings)


def run_attack(
    experiment: Experiment,
    folder: Path,
    display: StageDisplay,
    on_evaluation: OnEvaluation | None = None,
    on_prepared: Callable[[Prepared], None] | None = None,
) -> list[Path]:
    """Run every seed of a request in a folder, which stores the request too, resuming an interrupted run.

    Args:
        on_evaluation: Called after every evaluation, besides the display.
        on_prepared: Called before the search of each seed.

    Returns:
        The attack files, ``seed_<seed>.attack.safetensors``, each with its curve in a JSON file beside it, and of places with a picture.

    Raises:
        ConfigError: The folder holds another request, or results of files that have changed since, or the method cannot search the requested parameters.
        PluginError: The method's code cannot be loaded.
    """
    chosen_method(experiment)  # before anything is loaded or written
    require_utf8(folder.absolute())
    experiment = replace(experiment, folder=folder.resolve())
    keep_request(experiment)
    look_at_given(experiment)
    if experiment.config.attack.together:
        return _run_together(experiment, display, on_evaluation, on_prepared)
    prepared, files = None, []
    for seed in experiment.config.seeds:
        name = f"seed_{seed}"
        file = attack_file(folder, seed)
        files.append(file)
        if _is_done(experiment, seed):
            display.finish(name, 0.0, cached=True)
            continue
        prepared = prepare(experiment, seed) if prepared is None else prepared.with_seed(seed)
        if on_prepared is not None:
            on_prepared(prepared)
        _run_seed(prepared, display, on_evaluation)
    return files


def attack_file(folder: Path, seed: int) -> Path:
    """Path of the attack file of a seed."""
    return folder / f"seed_{seed}.attack.safetensors"


def keep_request(experiment: Experiment) -> None:
    """Write a request into its folder. Another one in it is refused once its search has begun; one that failed to load is replaced."""
    kept, text = experiment.folder / REQUEST, request_text(experiment)
    if not kept.exists() or not is_begun(experiment.folder):
        write_atomically(kept, text)
    elif kept.read_text(encoding="utf-8") != text:
        raise ConfigError(
            f"{kept}: this folder belongs to another attack; resume it, or choose another folder"
        )


def kept_request(folder: Path) -> Experiment:
    """The request of a folder."""
    return load_request(folder / REQUEST, folder=folder)


def _is_done(experiment: Experiment, seed: int) -> bool:
    """Whether a seed has its attack file and its curve.

    Raises:
        ConfigError: A file that the request names has changed since: the attack is of another policy, scene, object, calibration or code.
    """
    file = attack_file(experiment.folder, seed)
    curve = _curve_file(file)
    if not (file.exists() and curve.exists()):
        return False
    key = search_key(experiment, searched_cell(experiment, seed))
    # Of a folder from before curves had it nothing is known.
    if (kept := read_json(curve).get(_KEY, key)) != key:
        raise ConfigError(
            f"{file}: expected an attack on what the request names now ({key[:12]}), got one from before a file of its scene, policy, objects, "
            f"calibration or code changed ({kept[:12]}); choose another folder, or delete the file to search again"
        )
    return True


def _curve_file(file: Path) -> Path:
    """Path of the curve beside an attack file."""
    return file.with_name(f"{file.name.partition('.')[0]}.json")


def _run_seed(prepared: Prepared, display: StageDisplay, on_evaluation: OnEvaluation | None) -> None:
    name = f"seed_{prepared.seed}"
    state_path = prepared.experiment.folder / f"{name}.state.safetensors"
    report = display.start(name)
    report(0.0, "drive without attack")
    told = telling(planned_evaluations(prepared), report, prepared.clean_drive, prepared.problem.objective)
    result = search(prepared, state_path, _both(told, on_evaluation))
    _keep(prepared, result)
    state_path.unlink(missing_ok=True)
    display.finish(name, sum(e.seconds for e in result.history), cached=False)


def _run_together(
    experiment: Experiment,
    display: StageDisplay,
    on_evaluation: OnEvaluation | None,
    on_prepared: Callable[[Prepared], None] | None,
) -> list[Path]:
    """All seeds of a gradient attack in one batch; their files are written when all are finished."""
    seeds, wanted = experiment.config.seeds, experiment.config.attack
    state_path = experiment.folder / TOGETHER_STATE
    files = [attack_file(experiment.folder, seed) for seed in seeds]
    if all([_is_done(experiment, seed) for seed in seeds]):
        for seed in seeds:
            display.finish(f"seed_{seed}", 0.0, cached=True)
        return files
    prepared = prepare(experiment, seeds[0])
    each = [prepared, *(prepared.with_seed(seed) for seed in seeds[1:])]
    if on_prepared is not None:
        on_prepared(prepared)
    told = [
        _both(
            telling(
                wanted.evaluations,
                display.start(f"seed_{one.seed}"),
                one.clean_drive,
                one.problem.objective,
            ),
            on_evaluation,
        )
        for one in each
    ]
    with prepared.telling_unseen():
        results = gradient_attacks(
            all_on_chosen_device([one.problem for one in each]),
            seeds,
            wanted.evaluations,
            wanted.step or wanted.learning_rate,
            state_path,
            lambda k, evaluation: told[k](evaluation),
            prepared.settings_hash,
        )
    for one, result in zip(each, results, strict=True):
        _keep(one, result)
        display.finish(f"seed_{one.seed}", sum(e.seconds for e in result.history), cached=False)
    state_path.unlink(missing_ok=True)
    return files


def _keep(prepared: Prepared, result: SearchResult) -> None:
    """Write what a finished search found: the curve, of places a picture, and last the attack file, which says that the seed is done."""
    prepared.require_seen(result)
    file = attack_file(prepared.experiment.folder, prepared.seed)
    attack = make_attack_file(prepared, result)
    curve: dict[str, Any] = {
        "attack_id": attack.attack_id,
        "method": attack.method,
        "seed": prepared.seed,
        _KEY: prepared.settings_hash,
        "best_evaluation": result.best.iteration,
        "loss_m": [e.loss_m for e in result.history],
        "predicted_total_cte_m": [e.predicted_total_cte_m for e in result.history],
        "value": [e.value for e in result.history],
        "seconds": [e.seconds for e in result.history],
        "clean_drive": prepared.clean_drive.to_dict(),
        "placements": [each.placement for each in attack.objects],
    }
    if isinstance(prepared.space, places.PlaceSpace):
        write_atomically(file.with_name(f"seed_{prepared.seed}.poses.png"), draw_found(prepared, attack))
    write_json(_curve_file(file), curve)
    save_attack(file, attack)


def _both(first: OnEvaluation, second: OnEvaluation | None) -> OnEvaluation:
    if second is None:
        return first

    def told(evaluation: Evaluation) -> None:
        first(evaluation)
        second(evaluation)

    return told
