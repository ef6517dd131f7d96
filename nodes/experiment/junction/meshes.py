"""Attacks on meshes at the junction: the textures or the shapes of the five objects, over the deployment scene's own frames.

As in the paper nothing is learned for it: the background is what the simulator shows. What is found is then driven past like any other
attack, by the scene's own car, composed by depth. One call is one entry of the table, resumable, in the form of `cells.run_cell`.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.methods import METHODS, SearchRun, SearchSettings, load_method, method_name
from advnerf_core.attack.search.search import Evaluation, SearchResult
from advnerf_core.files import write_atomically
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.glb import read_glb, write_glb
from advnerf_core.objects.mesh.shape import ShapeLimits, ShapeSensor
from advnerf_core.objects.mesh.surface import sphere, unwrapped
from advnerf_core.objects.voxel.generators import GENERATORS
from advnerf_core.objects.voxel.mesh import SurfaceMesh, stand
from advnerf_core.policies.pilotnet import Policy, load_policy
from advnerf_core.report.conditions import NONE
from advnerf_core.scene.surrogate import Surrogate, split_theta
from hardware.worlds.world import DeploymentScene
from nodes.experiment.junction.attack import attack_problem
from nodes.experiment.junction.cells import CellError, require_known
from nodes.experiment.junction.context import Experiment
from nodes.experiment.junction.deployed import DressedScene
from nodes.experiment.junction.drives import deployed_drives, learned_drives, totals
from nodes.experiment.junction.objects import GENERATOR_OF
from nodes.experiment.junction.policy import attackable, victim_file
from nodes.experiment.request.frames import DeployedFrames
from nodes.experiment.request.telling import telling
from nodes.experiment.stages import hash_of
from nodes.runtime.machine import machine_name
from nodes.runtime.progress import Report

Target = Literal["texture", "shape"]
_HASHES: dict[str, list[str]] = {}


@dataclass(frozen=True)
class MeshSettings:
    """What is attacked of the meshes, and how far it may go.

    Attributes:
        target: Their textures, or their shapes.
        texels: Texels along the longest side of an object.
        ball_m: Objects are balls of this radius, before their own scale [m]; None leaves cars and hydrants.
        ball_rgb: Colour of the balls.
        limits: Of shapes.
        learning_rate: Of Adam; 0.1 for textures and a twentieth of the bound for shapes if not given.
    """

    target: Target = "texture"
    texels: int = 32
    ball_m: float | None = None
    ball_rgb: tuple[float, float, float] = (0.75, 0.1, 0.08)
    limits: ShapeLimits = field(default_factory=lambda: ShapeLimits(bound_m=0.4))
    learning_rate: float | None = None

    def __post_init__(self) -> None:
        sizes = [each for each in (self.ball_m, self.learning_rate) if each is not None]
        if self.texels < 1 or not all(np.isfinite(each) and each > 0.0 for each in sizes):
            raise ValueError(f"expected at least one texel, and a radius and a rate above zero, got {self}")


def mesh_objects(experiment: Experiment, settings: MeshSettings) -> list[MeshField]:
    """The world's objects as meshes, in their plain colours and shapes."""
    found = []
    for thing in experiment.world.objects:
        mesh: SurfaceMesh = (
            stand(GENERATORS[GENERATOR_OF[thing.kind]]())
            if settings.ball_m is None
            else sphere(settings.ball_m, settings.ball_rgb)
        )
        found.append(MeshField(unwrapped(mesh, settings.texels), thing.T_world_from_object, thing.scale))
    return found


def mesh_cell(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, folder: Path, report: Report,
    settings: MeshSettings | None = None, scene: DeploymentScene | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Search over the deployment scene's frames, drive there, and keep the result in ``folder``.

    Args:
        experiment: Its policies must be there (``advnerf experiment FILE --until policy``).
        scenario: Drive: straight, right or left.
        victim: hardened or naive, or retrained where the experiment retrains.
        method: none, or a method as `advnerf_core.attack.methods.load_method` takes it; shapes only with one that reads their scale.
        seed: Of the search and its starts.
        folder: Where the search state, the found meshes (GLB) and the results are kept.
        report: Told the finished fraction.
        settings: What is attacked.
        scene: The deployment scene; the simulated intersection is opened if none is given.

    Returns:
        The cell as JSON data, as `cells.run_cell` gives it; ``surrogate`` is the drive of the ideal car over the scene's frames.

    Raises:
        CellError: No such drive, victim or method.
        MeshEngineError: Mitsuba or LLVM is missing.
    """
    settings = settings or MeshSettings()
    require_cell(experiment, scenario, victim, method, settings)
    result = folder / _result_name(settings, scenario, victim, method, seed)
    frozen = mesh_hash(experiment, scenario, victim, seed, settings)
    if result.exists() and (kept := json.loads(result.read_text()))["settings_hash"] == frozen:
        return dict(kept)
    if scene is None:
        with experiment.site.open() as opened:
            return _cell(experiment, scenario, victim, method, seed, result, report, settings, frozen, opened)
    return _cell(experiment, scenario, victim, method, seed, result, report, settings, frozen, scene)


def found_meshes(
    experiment: Experiment,
    scenario: str,
    victim: str,
    method: str,
    seed: int,
    folder: Path,
    settings: MeshSettings,
) -> list[MeshField]:
    """The objects of a finished cell, read from the GLB files that it has written; the plain ones without an attack."""
    if method == NONE:
        return mesh_objects(experiment, settings)
    result = folder / _result_name(settings, scenario, victim, method, seed)
    return [
        MeshField(read_glb(_beside(result, f".{thing.name}.glb")), thing.T_world_from_object, thing.scale)
        for thing in experiment.world.objects
    ]


def _result_name(settings: MeshSettings, scenario: str, victim: str, method: str, seed: int) -> str:
    return f"mesh_{settings.target}_{scenario}_{victim}_{method_name(method)}_{seed}.cell.json"


def require_cell(experiment: Experiment, scenario: str, victim: str, method: str, settings: MeshSettings) -> None:
    """Refuse a cell that there cannot be.

    Raises:
        CellError: No such drive, victim or method, or a built-in method that cannot search shapes.
    """
    of_colours = [name for name, row in METHODS.items() if not row.reads_scale]
    refused = settings.target == "shape" and method in of_colours
    methods = [NONE, *(name for name in METHODS if name not in of_colours)] if refused else None
    require_known(experiment, scenario, attackable(experiment), victim, method, methods)


def mesh_hash(experiment: Experiment, scenario: str, victim: str, seed: int, settings: MeshSettings) -> str:
    """Hash of what a cell depends on, whatever its method."""
    attack = experiment.config.attack.model_dump(
        mode="json", exclude={"seeds", "methods", "starts", "start_sigma", "cem_population"}
    ) | {"cache_mib": type(experiment.config.attack)().cache_mib}  # how much memory may be used changes no result
    return hash_of({
        "objects": _objects_sha256(experiment, settings), "policy": load_policy(victim_file(experiment, victim)).sha256, "attack": attack,
        "starts": experiment.start_states(scenario, seed).tolist(), "limits": asdict(experiment.limits),
        "site": experiment.site.settings, "scenario": scenario, **_plain(settings),
    })  # fmt: skip


def _objects_sha256(experiment: Experiment, settings: MeshSettings) -> list[str]:
    key = hash_of([_plain(settings), [thing.model_dump(mode="json") for thing in experiment.world.objects]])
    if key not in _HASHES:  # unwrapping meshes takes seconds, and a campaign asks for every cell
        _HASHES[key] = [each.sha256 for each in mesh_objects(experiment, settings)]
    return _HASHES[key]


def _cell(
    experiment: Experiment, scenario: str, victim: str, method: str, seed: int, result: Path, report: Report,
    settings: MeshSettings, frozen: str, scene: DeploymentScene,
) -> dict[str, Any]:  # fmt: skip
    fields = mesh_objects(experiment, settings)
    policy = load_policy(victim_file(experiment, victim))
    view = DeployedFrames(scene, experiment.view)
    surrogate = Surrogate(view, experiment.view.pinhole, experiment.mount, fields, depth_tolerance_m=0.0)
    problem = attack_problem(experiment, surrogate, policy, scenario, seed)
    if settings.target == "shape":
        problem = replace(problem, sensor=ShapeSensor(surrogate, settings.limits))
    plain = surrogate.plain_theta() if settings.target == "texture" else torch.zeros(problem.sensor.theta_shape)
    theta = plain
    history: tuple[Evaluation, ...] = ()
    if method != NONE:
        found = _search(experiment, problem, method, seed, settings, result, report, frozen)
        theta, history = found.theta, found.history
        _keep_meshes(experiment, problem, fields, theta, result)
    clean, attacked = ({"surrogate": totals(learned_drives(experiment, problem, each)[1])} for each in (plain, theta))
    for drives, each in ((clean, plain), (attacked, theta)):
        drives["deployed"], blocked = _deployed(experiment, scene, problem, fields, each, scenario, policy.policy)
    data = {
        "scenario": scenario, "victim": victim, "method": method_name(method), "seed": seed, "attack_id": None, "settings_hash": frozen,
        "seconds": round(sum(evaluation.seconds for evaluation in history), 1),
        "machine": machine_name(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        **{name: {**attacked[name], "none_total_cte_m": clean[name]["total_cte_m"]} for name in ("surrogate", "deployed")},
        "extra": {
            "mesh": _plain(settings), "frames": "deployment", "evaluations": len(history),
            "curve_total_cte_m": [evaluation.predicted_total_cte_m for evaluation in history], "blocked_tick": blocked,
        },
    }  # fmt: skip
    write_atomically(result, json.dumps(data, indent=1) + "\n")
    _beside(result, ".state.safetensors").unlink(missing_ok=True)
    return data


def _search(
    experiment: Experiment, problem: AttackProblem, method: str, seed: int, settings: MeshSettings, result: Path,
    report: Report, settings_hash: str,
) -> SearchResult:  # fmt: skip
    attack = experiment.config.attack
    chosen = load_method(method)
    if settings.target == "shape" and not chosen.reads_scale:
        raise CellError(f"expected a method that searches shapes, got {method_name(method)}; attack textures with it")
    # No population: what a cell of meshes depends on leaves cem_population out.
    asked = SearchSettings(
        attack.evaluations,
        settings.learning_rate,
        cells=0,
        gradient_rate=attack.learning_rate,
        random_sigma=attack.random_sigma,
        options=chosen.options({}),
    )
    told = telling(chosen.evaluations(problem, asked), report)
    run = SearchRun(seed, _beside(result, ".state.safetensors"), told, settings_hash)
    return chosen.search(problem, asked, run)


def _keep_meshes(
    experiment: Experiment, problem: AttackProblem, fields: list[MeshField], theta: Tensor, result: Path
) -> None:
    """One GLB of each object as it was found, in its own frame."""
    if isinstance(problem.sensor, ShapeSensor):
        meshes = [shaped.mesh for shaped in problem.sensor.shaped(theta)]
    else:
        parts = split_theta(fields, theta)
        meshes = [each.mesh.with_texture(each.texture(part)) for each, part in zip(fields, parts, strict=True)]
    for thing, mesh in zip(experiment.world.objects, meshes, strict=True):
        write_glb(_beside(result, f".{thing.name}.glb"), mesh)


def _deployed(
    experiment: Experiment, scene: DeploymentScene, problem: AttackProblem, fields: list[MeshField], theta: Tensor,
    scenario: str, policy: Policy,
) -> tuple[dict[str, Any], list[int | None]]:  # fmt: skip
    """Drives of the scene's own car from all starts, past opaque objects in the camera's own pixels, and where they ran into something."""
    if isinstance(problem.sensor, ShapeSensor):
        fields, theta = problem.sensor.shaped(theta), problem.sensor.colours
    dressed = DressedScene(scene, experiment.view, fields)
    drives = deployed_drives(experiment, dressed, policy, scenario, problem.start_states, theta)
    return totals([drive.metrics for drive in drives]), [drive.blocked_tick for drive in drives]


def _plain(settings: MeshSettings) -> dict[str, Any]:
    data: dict[str, Any] = json.loads(json.dumps(asdict(settings)))
    return data


def _beside(result: Path, ending: str) -> Path:
    return result.with_name(result.name.removesuffix(".cell.json") + ending)
