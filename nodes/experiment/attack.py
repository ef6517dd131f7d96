"""Stage attack: for every victim and seed the gradient attack and random search, in the learned scene only."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch

from advnerf_core.attack.adjoint import AttackProblem, evaluate
from advnerf_core.attack.artifact import AttackFile, save_attack
from advnerf_core.attack.clean import clean_drive
from advnerf_core.attack.methods import Method, SearchRun, SearchSettings, load_method
from advnerf_core.attack.search.search import SearchResult, draw_start_states
from advnerf_core.attack.spaces.displayed import DisplayedSensor
from advnerf_core.driving.clean_drive import CleanDrive
from advnerf_core.files import write_atomically
from advnerf_core.policies.pilotnet import LoadedPolicy, load_policy
from advnerf_core.scene.surrogate import Surrogate
from nodes.experiment.context import Experiment
from nodes.experiment.learned_scene import load_background, scene_sha256
from nodes.experiment.objects import attacked_object, surrogate_of
from nodes.experiment.policy import HARDENED, NAIVE, victim_file
from nodes.experiment.request.objects import object_sha256
from nodes.experiment.request.telling import telling
from nodes.experiment.screen import shown
from nodes.experiment.stages import hash_of
from nodes.runtime.progress import Report

METHODS = ("random", "gradient")  # of an experiment; a campaign may compare any


@dataclass(frozen=True)
class Search:
    """One search.

    Attributes:
        victim: Which policy.
        method: Name of the method.
        seed: Of starts and search.
        reference: Where the method's code is, as `load_method` takes it, if its name does not say.
    """

    victim: str
    method: str
    seed: int
    reference: str = ""

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.victim}_{self.method}_{self.seed}"


def victims(experiment: Experiment) -> list[str]:
    """The policies that are attacked."""
    return [HARDENED, NAIVE] if experiment.config.policy.naive_steps else [HARDENED]


def searches(experiment: Experiment) -> list[Search]:
    """All searches: every seed against the hardened victim, the first also against the naive one."""
    seeds = experiment.config.attack.seeds
    plan = [Search(HARDENED, method, seed) for seed in seeds for method in METHODS]
    if NAIVE in victims(experiment):
        plan += [Search(NAIVE, method, seeds[0]) for method in METHODS]
    return plan


def start_states(experiment: Experiment, seed: int) -> torch.Tensor:
    """Start poses ``[B, 3]`` of one attack; the first is the nominal one."""
    attack = experiment.config.attack
    return draw_start_states(experiment.room.start_pose, attack.starts, attack.start_sigma, seed)


def frozen_hashes(experiment: Experiment) -> dict[str, str]:
    """What is fixed before the first attack: scene, victims, placement, starts and seeds."""
    policies = {
        f"policy_{name}": load_policy(victim_file(experiment, name)).sha256 for name in victims(experiment)
    }
    placement = np.asarray(attacked_object(experiment).T_world_from_object).tolist()
    starts = {str(seed): start_states(experiment, seed).tolist() for seed in experiment.config.attack.seeds}
    return {
        "scene": scene_sha256(experiment),
        **policies,
        "placement": hash_of(placement),
        "starts_and_seeds": hash_of(starts),
        "config": hash_of(experiment.config.model_dump(mode="json")),
    }


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Freeze, drive without attack, search; one attack file and one JSON of surrogate drives per search."""
    write_atomically(folder / "frozen.json", json.dumps(frozen_hashes(experiment), indent=1) + "\n")
    background = load_background(experiment)
    bare = surrogate_of(experiment, [], background)
    attacked = sensor_of(experiment, surrogate_of(experiment, [attacked_object(experiment)], background))
    plan = searches(experiment)
    for victim in victims(experiment):
        for seed in experiment.config.attack.seeds:
            drive_without_attack(experiment, bare, victim, seed, folder)
    for index, search in enumerate(plan):
        if (folder / f"{search.name}.json").exists():
            continue

        def progress(fraction: float, text: str = "", index: int = index, search: Search = search) -> None:
            report(
                (index + fraction) / len(plan), f"{search.victim} {search.method} seed {search.seed}: {text}"
            )

        run_search(experiment, attacked, search, folder, progress)


def sensor_of(experiment: Experiment, surrogate: Surrogate) -> Surrogate | DisplayedSensor:
    """What the attack looks through: on a monitor, the surrogate behind what the monitor does to colours."""
    in_loop = experiment.shown_on_monitor and experiment.config.attack.display_model
    return shown(experiment, surrogate) if in_loop else surrogate


def attack_problem(
    experiment: Experiment, surrogate: Surrogate | DisplayedSensor, policy: LoadedPolicy, seed: int
) -> AttackProblem:
    """The attack on one victim with the starts of one seed."""
    attack = experiment.config.attack
    fence = np.abs(np.array(experiment.room.fence_m)).min()
    return AttackProblem(
        policy.policy,
        surrogate,
        experiment.dynamics,
        experiment.path,
        start_states(experiment, seed),
        attack.horizon,
        time_batch=attack.time_batch,
        cache_bytes=int(attack.cache_mib * 2**20),
        fence_m=float(fence),
        off_track_m=experiment.room.off_track_m,
    )


def measured(experiment: Experiment, problem: AttackProblem) -> AttackProblem:
    """The same drive over the ticks that the protocol measures, whatever was optimised."""
    return replace(problem, steps=experiment.config.horizon)


def drive_without_attack(
    experiment: Experiment, bare: Surrogate, victim: str, seed: int, folder: Path
) -> None:
    """Drive in the learned scene without attack; leaves a JSON of the drives."""
    policy = load_policy(victim_file(experiment, victim))
    problem = measured(experiment, attack_problem(experiment, bare, policy, seed))
    rollout, totals = evaluate(problem, torch.zeros(bare.theta_shape))
    drives = {
        "states": rollout.states.transpose(0, 1).tolist(),
        "total_cte_m": totals.protocol_cte_m.tolist(),
    }
    write_atomically(folder / f"{victim}_none_{seed}.json", json.dumps(drives) + "\n")


def run_search(
    experiment: Experiment,
    surrogate: Surrogate | DisplayedSensor,
    search: Search,
    folder: Path,
    progress: Callable[..., None],
) -> None:
    """One search; leaves its attack file and a JSON of surrogate drives, and goes on from its state file if it was stopped."""
    method = load_method(search.reference or search.method)
    settings = search_settings(experiment, method)
    policy = load_policy(victim_file(experiment, search.victim))
    problem = attack_problem(experiment, surrogate, policy, search.seed)
    state_path = folder / f"{search.name}.state.safetensors"
    told = telling(method.evaluations(problem, settings), progress)
    searching = SearchRun(search.seed, state_path, told, hash_of(frozen_hashes(experiment)))
    result = method.search(problem, settings, searching)
    clean = clean_drive(problem, plain_theta(surrogate))
    attack_id = save_attack(
        attack_path(folder, search), _attack_file(experiment, policy, search, result, clean)
    )
    rollout, totals = evaluate(measured(experiment, problem), result.theta)
    drives = {
        "attack_id": attack_id,
        "clean_drive": clean.to_dict(),
        "states": rollout.states.transpose(0, 1).tolist(),
        "total_cte_m": totals.protocol_cte_m.tolist(),
        "curve_total_cte_m": [evaluation.predicted_total_cte_m for evaluation in result.history],
        "seconds": sum(evaluation.seconds for evaluation in result.history),
    }
    write_atomically(folder / f"{search.name}.json", json.dumps(drives) + "\n")
    state_path.unlink(missing_ok=True)


def search_settings(experiment: Experiment, method: Method) -> SearchSettings:
    """What a method may spend: the budget of the gradient attack if it needs a gradient, else that of random search."""
    attack = experiment.config.attack
    return SearchSettings(
        attack.iterations if method.needs_gradient else attack.random_evaluations,
        gradient_rate=attack.learning_rate,
        random_sigma=attack.random_sigma,
        options=method.options({}),
    )


def attack_path(folder: Path, search: Search) -> Path:
    """The attack file of a search."""
    return folder / f"{search.name}.attack.safetensors"


def plain_theta(sensor: Surrogate | DisplayedSensor) -> torch.Tensor:
    """The object's own colours, whatever is between them and the camera."""
    behind = sensor.sensor if isinstance(sensor, DisplayedSensor) else sensor
    assert isinstance(behind, Surrogate)
    return behind.plain_theta()


def _attack_file(
    experiment: Experiment, policy: LoadedPolicy, search: Search, result: SearchResult, clean: CleanDrive
) -> AttackFile:
    theta, field = result.theta.numpy().astype(np.float32), attacked_object(experiment)
    return AttackFile.of_face(
        method=search.method,
        theta=theta,
        size_m=(experiment.face_m, experiment.face_m),
        T_world_from_object=np.asarray(field.T_world_from_object),
        sha256=object_sha256(field),
        subject=experiment.target.subject,
        corners_in_subject=experiment.target.corners,
        camera=experiment.view.pinhole,
        scene_sha256=scene_sha256(experiment),
        policy_sha256=policy.sha256,
        config_sha256=hash_of(experiment.config.model_dump(mode="json")),
        seed=search.seed,
        predicted_total_cte_m=result.best.predicted_total_cte_m,
        software_version=version("advnerf"),
        extra={"victim": search.victim, "horizon": experiment.config.attack.horizon},
        clean_drive=clean,
    )
