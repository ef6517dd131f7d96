"""Running a prepared attack: the method that was asked for, resumable, ending in an attack file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from advnerf_core.attack.adjoint import BlackBoxError, evaluate
from advnerf_core.attack.artifact import AttackFile, save_attack
from advnerf_core.attack.methods import (
    Method,
    SearchRun,
    SearchSettings,
    alternatives,
    black_box_methods,
    load_method,
)
from advnerf_core.attack.objectives import load_objective
from advnerf_core.attack.on_device import all_on_chosen_device, on_chosen_device
from advnerf_core.attack.search.record import Evaluation, OnEvaluation, SearchResult
from advnerf_core.attack.search.together import gradient_attacks
from advnerf_core.files import write_atomically, write_json
from advnerf_core.places import require_utf8
from advnerf_core.plugins import name_in_results
from nodes.experiment.engine.telling import telling
from nodes.experiment.node.job import REQUEST, TOGETHER_STATE, is_begun
from nodes.experiment.node.prepare import Prepared, prepare
from nodes.experiment.node.request import SHAPE_METHODS, AttackRequest, load_request, request_text
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import StageDisplay


def chosen_method(request: AttackRequest) -> tuple[Method, SearchSettings]:
    """The method of a request, loaded, and its settings.

    Raises:
        PluginError: The method's code cannot be loaded.
        MethodError: It has no such options.
        ConfigError: It cannot search what is asked for.
    """
    wanted = request.search
    method = load_method(wanted.method)
    if load_objective(wanted.objective).needs_solids:
        raise ConfigError(
            f"search.objective: expected an objective that needs no solids, as a room calibration does not say what the car can hit, got "
            f"{name_in_results(wanted.objective)}; search for it in an experiment, whose world does"
        )
    if request.shape is not None and not method.reads_scale:
        raise ConfigError(
            f"search.method: expected a method that searches shapes, such as {SHAPE_METHODS}, got {wanted.method_name}"
        )
    settings = SearchSettings(
        wanted.evaluations,
        wanted.learning_rate,
        wanted.sigma,
        wanted.population,
        wanted.cells,
        wanted.probes,
        wanted.warm_pairs,
        options=method.options(wanted.options, "search.options"),
    )
    return method, settings


def search(
    prepared: Prepared, state_path: Path | None = None, on_evaluation: OnEvaluation | None = None
) -> SearchResult:
    """Search as the request asks; what ``on_evaluation`` raises ends it, and a state file then goes on from there."""
    method, settings = chosen_method(prepared.request)
    if method.needs_gradient and not prepared.problem.differentiable:
        raise BlackBoxError(
            f"{prepared.request.policy} has no gradient: use the method {alternatives(black_box_methods())}"
        )
    run = SearchRun(prepared.seed, state_path, on_evaluation, prepared.settings_hash)
    return method.search(on_chosen_device(prepared.problem), settings, run)


def planned_evaluations(prepared: Prepared) -> int:
    """Drives that the budget allows the method."""
    method, settings = chosen_method(prepared.request)
    return method.evaluations(prepared.problem, settings)


def finish(prepared: Prepared, result: SearchResult) -> AttackFile:
    """The attack file; its prediction is made without disturbances."""
    if prepared.problem.disturbances is None:
        return prepared.make_attack_file(result)
    _, totals = evaluate(prepared.problem.undisturbed(), result.theta)
    return prepared.make_attack_file(result, totals)


def run_attack(
    request: AttackRequest,
    folder: Path,
    display: StageDisplay,
    on_evaluation: OnEvaluation | None = None,
    on_prepared: Callable[[Prepared], None] | None = None,
) -> list[Path]:
    """Run every seed of a request in a folder, going on where it was stopped.

    Args:
        request: What is asked for; kept in the folder.
        folder: Where states and attack files go.
        display: Told of the progress of each seed.
        on_evaluation: Also called after every evaluation.
        on_prepared: Called before the search of each seed.

    Returns:
        The attack files, ``seed_<seed>.attack.safetensors``, each with its curve in a JSON file beside it.

    Raises:
        ConfigError: The folder holds another request, or the method cannot search what is asked for.
        PluginError: The method's code cannot be loaded.
    """
    chosen_method(request)  # before anything is loaded or written
    require_utf8(folder.absolute())
    keep_request(request, folder)
    if request.search.together:
        return _run_together(request, folder, display, on_evaluation, on_prepared)
    prepared, files = None, []
    for seed in request.search.seeds:
        name = f"seed_{seed}"
        file = attack_file(folder, seed)
        files.append(file)
        if file.exists():
            display.finish(name, 0.0, cached=True)
            continue
        prepared = prepare(request, seed) if prepared is None else prepared.with_seed(seed)
        if on_prepared is not None:
            on_prepared(prepared)
        _run_seed(prepared, folder, display, on_evaluation)
    return files


def attack_file(folder: Path, seed: int) -> Path:
    """Where the attack file of a seed is."""
    return folder / f"seed_{seed}.attack.safetensors"


def keep_request(request: AttackRequest, folder: Path) -> None:
    """Write the request into a folder. Another one in it is refused once its search has begun; one that failed to load is replaced."""
    kept = folder / REQUEST
    if not kept.exists() or not is_begun(folder):
        write_atomically(kept, request_text(request))
    elif load_request(kept) != request:
        raise ConfigError(
            f"{kept}: this folder belongs to another attack; resume it, or choose another folder"
        )


def kept_request(folder: Path) -> AttackRequest:
    """The request of a folder."""
    if not (folder / REQUEST).exists():
        raise ConfigError(
            f"expected a folder of 'advnerf attack run' with a {REQUEST}, found none in {folder}"
        )
    return load_request(folder / REQUEST)


def _run_seed(
    prepared: Prepared, folder: Path, display: StageDisplay, on_evaluation: OnEvaluation | None
) -> None:
    name, state_path = f"seed_{prepared.seed}", folder / f"seed_{prepared.seed}.state.safetensors"
    report = display.start(name)
    report(0.0, "drive without attack")
    told = telling(
        planned_evaluations(prepared), report, prepared.clean_drive, objective=prepared.problem.objective
    )
    result = search(prepared, state_path, _both(told, on_evaluation))
    _keep(prepared, result, folder)
    state_path.unlink(missing_ok=True)
    display.finish(name, sum(e.seconds for e in result.history), cached=False)


def _run_together(
    request: AttackRequest,
    folder: Path,
    display: StageDisplay,
    on_evaluation: OnEvaluation | None,
    on_prepared: Callable[[Prepared], None] | None,
) -> list[Path]:
    """All seeds of a gradient attack in one batch; their files are written when all are done."""
    seeds, state_path = request.search.seeds, folder / TOGETHER_STATE
    files = [attack_file(folder, seed) for seed in seeds]
    if all(file.exists() for file in files):
        for seed in seeds:
            display.finish(f"seed_{seed}", 0.0, cached=True)
        return files
    prepared = prepare(request, seeds[0])
    each = [prepared, *(prepared.with_seed(seed) for seed in seeds[1:])]
    if on_prepared is not None:
        on_prepared(prepared)
    told = [
        _both(
            telling(
                request.search.evaluations,
                display.start(f"seed_{one.seed}"),
                one.clean_drive,
                one.problem.objective,
            ),
            on_evaluation,
        )
        for one in each
    ]
    results = gradient_attacks(
        all_on_chosen_device([one.problem for one in each]),
        seeds,
        request.search.evaluations,
        request.search.learning_rate or 0.1,
        state_path,
        lambda k, evaluation: told[k](evaluation),
        prepared.settings_hash,
    )
    for one, result in zip(each, results, strict=True):
        _keep(one, result, folder)
        display.finish(f"seed_{one.seed}", sum(e.seconds for e in result.history), cached=False)
    state_path.unlink(missing_ok=True)
    return files


def _keep(prepared: Prepared, result: SearchResult, folder: Path) -> None:
    """Write the attack file of a finished search, and its curve beside it."""
    attack_id = save_attack(attack_file(folder, prepared.seed), finish(prepared, result))
    curve = {
        "attack_id": attack_id,
        "method": prepared.request.search.method_name,
        "seed": prepared.seed,
        "best_evaluation": result.best.iteration,
        "loss_m": [e.loss_m for e in result.history],
        "predicted_total_cte_m": [e.predicted_total_cte_m for e in result.history],
        "value": [e.value for e in result.history],
        "seconds": [e.seconds for e in result.history],
        "clean_drive": prepared.clean_drive.to_dict(),
    }
    write_json(folder / f"seed_{prepared.seed}.json", curve)


def _both(first: OnEvaluation, second: OnEvaluation | None) -> OnEvaluation:
    if second is None:
        return first

    def told(evaluation: Evaluation) -> None:
        first(evaluation)
        second(evaluation)

    return told
