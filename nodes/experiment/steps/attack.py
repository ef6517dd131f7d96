"""The surrogate part of a cell: the search, its attack file, and the drives past the attack."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from advnerf_core.attack.adjoint import AttackProblem, evaluate
from advnerf_core.attack.artifact import AttackFile, load_attack, save_attack
from advnerf_core.attack.clean import clean_drive_and_value
from advnerf_core.attack.image_gradients import agrees_in_bfloat16
from advnerf_core.attack.methods import Method, SearchRun, SearchSettings, load_method
from advnerf_core.attack.objective import CrossTrackError, Objective
from advnerf_core.attack.objectives import CTE, load_objective, objective_entry, objective_key
from advnerf_core.attack.on_device import on_chosen_device, said_of_device
from advnerf_core.attack.problem import ZeroGradientError
from advnerf_core.attack.robustness import Disturbances, Smoothness
from advnerf_core.attack.search.record import Evaluation, OnEvaluation, SearchResult
from advnerf_core.attack.spaces.space import Shown, Space, half_precision
from advnerf_core.documents import read_json
from advnerf_core.driving.clean_drive import CleanDrive
from advnerf_core.driving.dynamics import Dynamics
from advnerf_core.files import write_atomically
from advnerf_core.policies.policy_file import LoadedPolicy
from advnerf_core.report.conditions import EMPTY
from hardware.worlds.world import World
from nodes.experiment.engine.artefact import Settings, hash_of
from nodes.experiment.engine.run_folder import ATTACK, SEARCHED
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.method_names import keep_title
from nodes.experiment.plan.space_config import (
    ColoursConfig,
    MeshShapeConfig,
    MeshTextureConfig,
    PlacesConfig,
)
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.deployed import Dressed
from nodes.experiment.show.drives import learned_drives, totals
from nodes.experiment.show.learned_scene import baked_file, load_field, scene_sha256
from nodes.experiment.show.spaces import dress, over_the_world, shown_there
from nodes.experiment.show.victims import load_victim, told
from nodes.experiment.steps.frozen import frozen_for, hardness_before
from nodes.experiment.steps.keys import registered_settings, search_key
from nodes.runtime.errors import ConfigError

_STATE = "state.safetensors"


@dataclass(frozen=True, eq=False)
class Prepared:
    """An attack, ready for the search.

    Attributes:
        cell: The victim, path and method of the attack, and the seed of starts, search and disturbances.
        policy: The victim with its view and hash.
    """

    experiment: Experiment
    cell: Cell
    policy: LoadedPolicy
    space: Space
    problem: AttackProblem

    @classmethod
    def of(cls, experiment: Experiment, space: Space, cell: Cell) -> Prepared:
        """The attack of a cell, with its name in the experiment."""
        policy = load_victim(experiment, cell.victim)
        problem = attack_problem(experiment, space, policy, cell.scenario, cell.seed)
        return cls(experiment, cell, policy, space, problem)

    @property
    def seed(self) -> int:
        """Seed of starts, search and disturbances."""
        return self.cell.seed

    @property
    def settings_hash(self) -> str:
        """Hash of everything that must be the same when a search is resumed."""
        return search_key(self.experiment, self.cell)

    def with_seed(self, seed: int) -> Prepared:
        """The same attack with another seed: other starts, other draws."""
        problem = attack_problem(self.experiment, self.space, self.policy, self.cell.scenario, seed)
        return replace(self, cell=replace(self.cell, seed=seed), problem=problem)

    @property
    def clean_drive(self) -> CleanDrive:
        """The victim's drive past the plain objects, from the same starts in the same scene."""
        return self._clean[0]

    @property
    def clean_value(self) -> float:
        """The objective's value of that drive, mean over the starts, in its unit."""
        return self._clean[1]

    @cached_property
    def _clean(self) -> tuple[CleanDrive, float]:
        plain = self.space.plain
        return clean_drive_and_value(past(self.problem, self.space, plain), plain.colours)

    def require_seen(self, found: SearchResult) -> None:
        """Raise for a search whose objects are never in view: its result would look like a robust policy.

        Equal drives alone may be of a policy that ignores the objects, so that pictures are compared.

        Raises:
            ConfigError: No picture of the drive depends on the objects.
        """
        differ = len({each.total_cte_m for each in found.history}) > 1
        if not (differ and self.problem.undisturbed() is self.problem):
            self._require_pictures_of(found.theta)

    @contextmanager
    def telling_unseen(self) -> Iterator[None]:
        """Say of a search that has no gradient to begin with whether its objects are out of view."""
        try:
            yield
        except ZeroGradientError as error:
            self._require_pictures_of(error.theta.cpu())
            raise

    def _require_pictures_of(self, theta: torch.Tensor) -> None:
        if isinstance(self.experiment.config.space, MeshShapeConfig):
            return
        problem = self.problem.undisturbed()
        rollout, _ = evaluate(problem, theta)
        for tick, states in enumerate(rollout.states[:-1]):
            one, other = (problem.sense((tick,), states, each) for each in (theta, 1.0 - theta))
            if not torch.equal(one.images, other.images):
                return
        names = ", ".join(each.name for each in self.experiment.objects) or "the attacked face"
        raise ConfigError(
            f"expected {names} in view of the searched drives, got {len(rollout.states) - 1} ticks whose pictures do not depend on it; "
            "move it (x_m, y_m, z_m, yaw_rad, scale), or the starts; if it stands in view, the scene hides it: take more photographs, or let it learn longer"
        )


def surrogate_part(
    experiment: Experiment, space: Space, cell: Cell, folder: Path, report: Callable[..., None]
) -> dict[str, Any]:
    """Search if the cell has a method, drive in the surrogate, and store both in its folder, as ``attack.safetensors`` and ``surrogate.json``.

    Existing parts are read.

    Returns:
        Attack id (None without an attack), states and metrics of the drives, the curve of the search [m], and its seconds.
    """
    kept = folder / SEARCHED
    if kept.exists() and (not cell.searched or (folder / ATTACK).exists()):
        found: dict[str, Any] = read_json(kept)
        return found
    prepared = Prepared.of(experiment, space, cell)
    attack_id, curve, seconds = None, [], 0.0
    values: dict[str, Any] = {}
    if cell.searched:
        result = _search(prepared, folder, report)
        prepared.require_seen(result)
        seconds = sum(evaluation.seconds for evaluation in result.history)
        curve = [evaluation.predicted_total_cte_m for evaluation in result.history]
        attack = attack_file(prepared, replace(result, theta=half_precision(result.theta)))
        if experiment.config.attack.objective != CTE:
            values = {"curve_value": [evaluation.value for evaluation in result.history]}
            values["objective"] = attack.extra["objective"]
        attack_id = save_attack(folder / ATTACK, attack)
    data = {
        "attack_id": attack_id,
        "policy_sha256": prepared.policy.sha256,
        "hardness": hardness_before(folder),
        **surrogate_drives(experiment, space, cell, folder),
        "curve_total_cte_m": curve,
        **values,
        "seconds": seconds,
    }
    write_atomically(kept, json.dumps(data) + "\n")
    (folder / _STATE).unlink(missing_ok=True)
    return data


def surrogate_drives(experiment: Experiment, space: Space, cell: Cell, folder: Path) -> dict[str, Any]:
    """Drives in the surrogate from the measured starts, past the ``attack.safetensors`` in a folder; for a control no file is read.

    Returns:
        States ``[S, T + 1, n]``, commands ``[S, T]`` and metrics, as JSON data.
    """
    problem, shown = Prepared.of(experiment, space, cell).problem, load_shown(space, folder, cell)
    measured = from_measured_starts(experiment, cell.scenario, past_field(experiment, problem, space, shown))
    states, commands, scores = learned_drives(experiment, measured, shown.colours)
    return {
        "states": states.tolist(),
        "commands": commands.tolist(),
        **totals(scores),
        "mean_cte_m": [score.mean_cte_m for score in scores],
        "time_to_leave_s": [score.time_to_leaving_s for score in scores],
    }


def attack_problem(
    experiment: Experiment, space: Space, policy: LoadedPolicy, scenario: str, seed: int
) -> AttackProblem:
    """The attack on one victim on one drive, with the starts of one seed."""
    attack, robustness = experiment.config.attack, experiment.config.attack.robustness
    # Drives of one start differ by their random draws.
    starts = experiment.start_states(scenario, seed).repeat_interleave(robustness.repeats, dim=0)
    told_goals = attack.goals or [told(experiment, policy.policy, scenario)]
    dynamics, objective = experiment.searched_dynamics, load_objective(attack.objective)
    return AttackProblem(
        policy.policy,
        space.sensor,
        dynamics,
        experiment.paths[scenario],
        _at_rest(starts, dynamics),
        experiment.searched_ticks,
        _goals(experiment, policy.policy, told_goals, len(starts)),
        time_batch=attack.time_batch,
        cache_bytes=int(attack.cache_mib * 2**20),
        fence_m=experiment.world.fence_m,
        held_cap_m=experiment.config.held_cap_m,
        off_track_m=experiment.world.off_track_m,
        disturbances=Disturbances(**robustness.spreads, seed=seed) if robustness.disturbed else None,
        regulariser=Smoothness(space.surrogate.objects, robustness.smoothness)
        if robustness.smoothness
        else None,
        objective=objective,
        solids=experiment.solids if objective.needs_solids else None,
        reduced=agrees_in_bfloat16(policy.policy, experiment.view.pinhole, int(policy.policy.goal_size)),
    )


def _at_rest(starts: torch.Tensor, dynamics: Dynamics) -> torch.Tensor:
    """Start states ``[B, n]`` of start poses ``[B, 3]``: wheels are straight, and no command is under way."""
    return torch.nn.functional.pad(starts, (0, dynamics.state_size - starts.shape[1]))


def _goals(
    experiment: Experiment, policy: Any, goals: Sequence[tuple[float, ...]], count: int
) -> torch.Tensor | None:
    """Goals ``[B, n]`` of drives from a number of starts, one for all or one for each; None for a policy that takes none."""
    lengths = {len(goal) for goal in goals}
    if lengths != {int(policy.goal_size)}:
        raise ConfigError(
            f"{experiment.file}: attack.goals: expected vectors of length {policy.goal_size} for this policy (0: none), got lengths "
            f"{', '.join(map(str, sorted(lengths)))}"
        )
    if lengths == {0}:
        return None
    return torch.tensor(goals, dtype=torch.float32).repeat_interleave(count // len(goals), dim=0)


def from_measured_starts(experiment: Experiment, scenario: str, problem: AttackProblem) -> AttackProblem:
    """The problem with the measured starts and horizon, and without disturbances."""
    starts = experiment.measured_starts(scenario)
    goals = _goals(experiment, problem.policy, [told(experiment, problem.policy, scenario)], len(starts))
    return replace(
        problem.undisturbed(),
        start_states=_at_rest(starts, problem.dynamics),
        goals=goals,
        steps=experiment.config.horizon,
    )


def past(problem: AttackProblem, space: Space, shown: Shown) -> AttackProblem:
    """The problem with the surrogate as its sensor, with the shown objects; its theta are their colours."""
    return replace(problem, sensor=shown.seen_by(space.surrogate))


def past_field(experiment: Experiment, problem: AttackProblem, space: Space, shown: Shown) -> AttackProblem:
    """`past` in the learned scene itself, if searches use the baked one: finished attacks are measured in it, if not asked otherwise."""
    seen = shown.seen_by(space.surrogate)
    if _measured_in_field(experiment):
        seen = seen.with_background(load_field(experiment))
    return replace(problem, sensor=seen)


def _measured_in_field(experiment: Experiment) -> bool:
    return experiment.config.measure.scene == "field" and not over_the_world(experiment)


def load_shown(space: Space, folder: Path, cell: Cell) -> Shown:
    """The attacked objects of a search's attack file; for a control the plain objects, or none."""
    if cell.method == EMPTY:
        return Shown((), torch.zeros(0, 3))
    attack = load_found(folder, cell)
    return space.plain if attack is None else space.restored(attack)


def dress_cell(
    experiment: Experiment, scene: World, space: Space, folder: Path, cell: Cell
) -> tuple[Dressed, torch.Tensor | None]:
    """An open deployment scene with the attacked objects of a cell, and what they show there, see `shown_there`."""
    shown = load_shown(space, folder, cell)
    return dress(experiment, scene, shown), shown_there(experiment, shown, load_found(folder, cell))


def load_found(folder: Path, cell: Cell) -> AttackFile | None:
    """The attack file of a search; None for a control."""
    return load_attack(folder / ATTACK) if cell.searched else None


def search_settings(experiment: Experiment, method: Method) -> SearchSettings:
    """Budget and settings of a search."""
    attack, space = experiment.config.attack, experiment.config.space
    cells = space.cells if isinstance(space, ColoursConfig) else 0
    of_meshes = space.learning_rate if isinstance(space, (MeshTextureConfig, MeshShapeConfig)) else None
    return SearchSettings(
        evaluations=planned_evaluations(experiment),
        learning_rate=attack.step or of_meshes,
        sigma=attack.sigma,
        population=attack.population,
        cells=cells,
        probes=attack.probes,
        warm_pairs=attack.warm_pairs,
        gradient_rate=attack.learning_rate,
        random_sigma=attack.random_sigma,
        options=method.own_options(attack.options, "attack.options"),
    )


def planned_evaluations(experiment: Experiment) -> int:
    """Number of drives of each search."""
    space = experiment.config.space
    return (space if isinstance(space, PlacesConfig) else experiment.config.attack).evaluations


def _search(prepared: Prepared, folder: Path, report: Callable[..., None]) -> SearchResult:
    experiment, cell, problem = prepared.experiment, prepared.cell, prepared.problem
    objective = objective_key(experiment.config.attack.objective)
    settings = Settings.of(
        experiment.config,
        {"space": True},
        **frozen_for(experiment, cell),
        scenario=cell.scenario,
        objective=objective,
    )
    method = load_method(cell.code)
    keep_title(folder.parent, cell.method, method.title)
    budget = search_settings(experiment, method)
    told = telling(method.evaluations(problem, budget), report, None, problem.objective)
    run = SearchRun(cell.seed, folder / _STATE, told, settings.key)
    with prepared.telling_unseen():
        return prepared.space.search(cell.code, on_chosen_device(problem), budget, run)


def telling(
    evaluations: int,
    report: Callable[[float, str], None],
    clean: CleanDrive | None,
    objective: Objective,
) -> OnEvaluation:
    """A callback that reports evaluations as progress: the finished fraction, and as text the last and the best total, and the total without attack.

    The last and the best value of an objective other than ``cte`` are reported too.
    """
    best: Evaluation | None = None
    beside = "" if clean is None else f", {clean.short}"

    def told(evaluation: Evaluation) -> None:
        nonlocal best
        if best is None or evaluation.value > best.value:
            best = evaluation
        done, total_m = evaluation.iteration + 1, evaluation.predicted_total_cte_m
        best_m = best.predicted_total_cte_m
        text = f"total CTE {total_m:.1f} m, best {best_m:.1f} m"
        if objective != CrossTrackError():
            unit = objective.unit
            text = f"{evaluation.value:.2f} {unit}, best {best.value:.2f} {unit}, total CTE {total_m:.1f} m"
        report(done / evaluations, f"{done}/{evaluations}, {text}{beside}")

    return told


def attack_file(prepared: Prepared, result: SearchResult) -> AttackFile:
    """The attack file of a search's result; its prediction is made without disturbances."""
    experiment, space, problem = prepared.experiment, prepared.space, prepared.problem
    attack = AttackFile(
        method=prepared.cell.method,
        space=space.name,
        objects=space.attacked(result.theta),
        face=None,
        camera=experiment.view.pinhole,
        scene_sha256=hash_of(experiment.world_settings)
        if over_the_world(experiment)
        else scene_sha256(experiment),
        policy_sha256=prepared.policy.sha256,
        config_sha256=registered_settings(experiment).key,
        seed=prepared.seed,
        predicted_total_cte_m=result.best.predicted_total_cte_m,
        software_version=version("advnerf"),
        extra=_extra(prepared, result),
        clean_drive=prepared.clean_drive,
    )
    if space.mount is not None:
        attack = replace(attack, face=space.mount.face(attack.objects))
    shown = space.restored(attack)
    if problem.disturbances is not None:
        _, found = evaluate(past(problem.undisturbed(), space, shown), shown.colours)
        entry = objective_entry(
            experiment.config.attack.objective,
            problem.objective,
            float(found.values.mean()),
            prepared.clean_value,
        )
        total_m = float(found.protocol_cte_m.mean())
        attack = replace(attack, predicted_total_cte_m=total_m, extra=attack.extra | entry)
    if not _measured_in_field(experiment) or not baked_file(experiment).exists():
        return attack
    _, totals_m = evaluate(past_field(experiment, problem.undisturbed(), space, shown), shown.colours)
    return replace(attack, field_total_cte_m=float(totals_m.protocol_cte_m.mean()))


def _extra(prepared: Prepared, result: SearchResult) -> dict[str, Any]:
    """Further data of an attack file beside its fields."""
    experiment, problem = prepared.experiment, prepared.problem
    found = {
        "experiment": experiment.config.name,
        "victim": prepared.cell.victim,
        "scenario": prepared.cell.scenario,
        "horizon": experiment.searched_ticks,
        "evaluations": len(result.history),
        "start_states": problem.start_states[:, :3].tolist(),
        "searched_space": experiment.config.space.model_dump(mode="json"),
        **said_of_device(),
        **objective_entry(
            experiment.config.attack.objective, problem.objective, result.best.value, prepared.clean_value
        ),
    }
    if identity := prepared.policy.metadata.get("not_fixed"):
        found["policy_not_fixed"] = identity
    return found
