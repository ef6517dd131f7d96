"""Stage attack: for each drive, victim and seed the searches at equal evaluations, in the learned junction only."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.artifact import AttackedObject, AttackFile, load_attack, save_attack
from advnerf_core.attack.clean import clean_drive
from advnerf_core.attack.methods import SearchRun, SearchSettings, load_method, method_name
from advnerf_core.attack.search.search import SearchResult
from advnerf_core.driving.clean_drive import CleanDrive
from advnerf_core.files import write_atomically
from advnerf_core.policies.pilotnet import LoadedPolicy, load_policy
from advnerf_core.report.conditions import NONE
from advnerf_core.scene.surrogate import Surrogate, split_theta
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.drives import learned_drives, totals
from nodes.experiment.junction.objects import object_file, placed_objects, surrogate_of
from nodes.experiment.junction.policy import HARDENED, victim_file, victims
from nodes.experiment.learned_scene import scene_sha256
from nodes.experiment.request.telling import telling
from nodes.experiment.stages import hash_of
from nodes.runtime.progress import Report


@dataclass(frozen=True)
class Cell:
    """One entry of the transfer table.

    Attributes:
        scenario: Which drive.
        victim: Which policy.
        method: Name of the method, or ``none``.
        seed: Of starts and search.
        reference: Where the method's code is, as `load_method` takes it, if its name does not say.
    """

    scenario: str
    victim: str
    method: str
    seed: int
    reference: str = field(default="", compare=False)

    @classmethod
    def of(cls, scenario: str, victim: str, method: str, seed: int) -> Cell:
        """The cell of a method as `load_method` takes it, or of ``none``."""
        name = method_name(method)
        return cls(scenario, victim, name, seed, "" if method == name else method)

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.scenario}_{self.victim}_{self.method}_{self.seed}"

    @property
    def clean(self) -> Cell:
        """The same drive past the plain objects."""
        return Cell(self.scenario, self.victim, NONE, self.seed)


def cells(experiment: Experiment) -> list[Cell]:
    """All cells in order: every seed against the hardened victim, the first also against the naive one; quick ones first."""
    seeds, methods = experiment.config.attack.seeds, experiment.config.attack.methods
    rows = [(victim, seed) for victim in victims(experiment) for seed in (seeds if victim == HARDENED else seeds[:1])]
    return [
        Cell.of(scenario, victim, condition, seed)
        for victim, seed in rows
        for condition in (NONE, *methods)
        for scenario in experiment.config.scenarios
    ]


def frozen_hashes(experiment: Experiment) -> dict[str, str]:
    """What is fixed before the first attack: scene, victims, objects and their places, starts and seeds."""
    policies = {f"policy_{name}": load_policy(victim_file(experiment, name)).sha256 for name in victims(experiment)}
    starts = {
        f"{scenario} {seed}": experiment.start_states(scenario, seed).tolist()
        for scenario in experiment.config.scenarios
        for seed in experiment.config.attack.seeds
    }
    return {
        "scene": scene_sha256(experiment),
        **policies,
        **frozen_objects(experiment),
        "starts_and_seeds": hash_of(starts),
        "config": hash_of(experiment.config.model_dump(mode="json")),
    }


def frozen_objects(experiment: Experiment) -> dict[str, str]:
    """Hashes of the objects, and of where they were placed by hand."""
    things = experiment.world.objects
    return {
        "objects": hash_of([hash_of(_geometry(experiment, thing.kind)) for thing in things]),
        "placement": hash_of([thing.model_dump(mode="json") for thing in things]),
    }


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Freeze, then search what is not searched yet; one attack file and one JSON of surrogate drives per cell."""
    write_atomically(folder / "frozen.json", json.dumps(frozen_hashes(experiment), indent=1) + "\n")
    surrogate = surrogate_of(experiment, placed_objects(experiment))
    plan = cells(experiment)
    for index, cell in enumerate(plan):

        def progress(fraction: float, text: str = "", index: int = index, cell: Cell = cell) -> None:
            report(
                (index + fraction) / len(plan), f"{cell.scenario} {cell.victim} {cell.method} seed {cell.seed}: {text}"
            )

        surrogate_part(experiment, surrogate, cell, folder, progress)


def surrogate_part(
    experiment: Experiment, surrogate: Surrogate, cell: Cell, folder: Path, report: Callable[..., None]
) -> dict[str, Any]:
    """Search if the cell has a method, drive in the surrogate, and keep both; what is there already is read."""
    kept = folder / f"{cell.name}.json"
    if kept.exists():
        found: dict[str, Any] = json.loads(kept.read_text())
        return found
    policy = _victim(victim_file(experiment, cell.victim))
    problem = attack_problem(experiment, surrogate, policy, cell.scenario, cell.seed)
    attack_id, curve, seconds, theta = None, [], 0.0, surrogate.plain_theta()
    if cell.method != NONE:
        result = _search(experiment, problem, cell, folder, report)
        theta, seconds = result.theta, sum(evaluation.seconds for evaluation in result.history)
        curve = [evaluation.predicted_total_cte_m for evaluation in result.history]
        clean = clean_drive(problem, surrogate.plain_theta())
        attack_id = save_attack(
            attack_path(folder, cell), _attack_file(experiment, surrogate, policy, cell, result, clean)
        )
    states, scores = learned_drives(experiment, problem, theta)
    data = {
        "attack_id": attack_id, "states": states.tolist(), **totals(scores), "mean_cte_m": [score.mean_cte_m for score in scores],
        "curve_total_cte_m": curve, "seconds": seconds,
    }  # fmt: skip
    write_atomically(kept, json.dumps(data) + "\n")
    _state_path(folder, cell).unlink(missing_ok=True)
    return data


def attack_problem(
    experiment: Experiment, surrogate: Surrogate, policy: LoadedPolicy, scenario: str, seed: int
) -> AttackProblem:
    """The attack on one victim on one drive, with the starts of one seed."""
    attack, starts = experiment.config.attack, experiment.start_states(scenario, seed)
    goals = torch.tensor([experiment.goal(scenario)], dtype=torch.float32).expand(len(starts), -1)
    return AttackProblem(
        policy.policy, surrogate, experiment.dynamics, experiment.paths[scenario], starts, experiment.config.horizon, goals,
        time_batch=attack.time_batch, cache_bytes=int(attack.cache_mib * 2**20), held_cap_m=experiment.config.held_cap_m,
        off_track_m=experiment.site.off_track_m,
    )  # fmt: skip


def attack_path(folder: Path, cell: Cell) -> Path:
    """The attack file of a cell."""
    return folder / f"{cell.name}.attack.safetensors"


def load_theta(folder: Path, cell: Cell) -> torch.Tensor:
    """Colours of all objects ``[K, 3]`` that a search found."""
    objects = load_attack(attack_path(folder, cell)).objects
    return torch.cat([torch.from_numpy(thing.theta).reshape(-1, 3) for thing in objects])


def _search(
    experiment: Experiment, problem: AttackProblem, cell: Cell, folder: Path, report: Callable[..., None]
) -> SearchResult:
    attack = experiment.config.attack
    frozen = {
        key: value for key, value in frozen_hashes(experiment).items() if key not in ("config", "starts_and_seeds")
    }
    method = load_method(cell.reference or cell.method)
    settings = SearchSettings(
        attack.evaluations,
        population=attack.cem_population,
        cells=0,  # objects that are no face have no coarse texture: every colour is searched
        gradient_rate=attack.learning_rate,
        random_sigma=attack.random_sigma,
        options=method.options({}),
    )
    told = telling(method.evaluations(problem, settings), report)
    digest = hash_of({**frozen, "victim": cell.victim, "scenario": cell.scenario})
    return method.search(problem, settings, SearchRun(cell.seed, _state_path(folder, cell), told, digest))


def _state_path(folder: Path, cell: Cell) -> Path:
    return folder / f"{cell.name}.state.safetensors"


@lru_cache(maxsize=4)
def _victim(path: Path) -> LoadedPolicy:
    return load_policy(path)


@lru_cache(maxsize=8)
def _file_hash(path: Path, changed_ns: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _geometry(experiment: Experiment, kind: str) -> str:
    path = object_file(experiment, kind)
    return _file_hash(path, path.stat().st_mtime_ns)


def _attack_file(
    experiment: Experiment,
    surrogate: Surrogate,
    policy: LoadedPolicy,
    cell: Cell,
    result: SearchResult,
    clean: CleanDrive,
) -> AttackFile:
    parts = split_theta(surrogate.objects, result.theta)
    objects = tuple(
        AttackedObject(
            thing.name, part.detach().numpy().astype(np.float32), thing.T_world_from_object, thing.scale,
            _geometry(experiment, thing.kind),
        )
        for thing, part in zip(experiment.world.objects, parts, strict=True)
    )  # fmt: skip
    return AttackFile(
        method=cell.method, theta=np.zeros((0, 0, 3), np.float32), texture=np.zeros((0, 0, 3), np.uint8), size_m=(0.0, 0.0),
        T_world_from_object=np.eye(4), subject="", corners_in_subject=np.zeros((4, 3)), camera=experiment.view.pinhole,
        scene_sha256=scene_sha256(experiment), policy_sha256=policy.sha256,
        config_sha256=hash_of(experiment.config.model_dump(mode="json")), seed=cell.seed,
        predicted_total_cte_m=result.best.predicted_total_cte_m, software_version=version("advnerf"),
        extra={"victim": cell.victim, "scenario": cell.scenario, "horizon": experiment.config.horizon}, objects=objects, clean_drive=clean,
    )  # fmt: skip
