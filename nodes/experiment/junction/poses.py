"""Pose attacks at the junction: cars and hydrants are moved beside the lanes, and coloured, until the policy leaves its lane.

The paper's last colour experiment: a victim that was retrained on colour attacks and on objects at random places (stage retrain with
``retrain.placements``) is attacked in places and colours together, five placements refined by ten gradient steps each, the best of fifty;
as many random places and colours are the baseline.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem
from advnerf_core.attack.search.pose_attack import FoundPoses, pose_attack, randomly_placed
from advnerf_core.attack.search.poses import MultiStart
from advnerf_core.attack.spaces.placement import KeepOut, PoseBounds, placed
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.files import write_atomically
from advnerf_core.policies.pilotnet import LoadedPolicy
from advnerf_core.scene.surrogate import Surrogate
from hardware.worlds.junction.config import PlacedObject
from hardware.worlds.world import DeploymentScene
from nodes.experiment.junction.attack import attack_problem, frozen_objects
from nodes.experiment.junction.context import Experiment, as_path
from nodes.experiment.junction.deployed import DressedScene
from nodes.experiment.junction.drives import deployed_drives, learned_drives, totals
from nodes.experiment.junction.objects import placed_objects, surrogate_of
from nodes.experiment.learned_scene import scene_sha256
from nodes.experiment.request.telling import telling
from nodes.experiment.stages import hash_of
from nodes.runtime.machine import machine_name
from nodes.runtime.progress import Report

PoseMethod = Literal["none", "random", "gradient"]


@dataclass(frozen=True)
class PoseSettings:
    """How far the objects may be moved from where they were placed by hand, and how long is searched.

    Attributes:
        move_m: An object's x and y may change by this [m].
        turn_rad: A car's heading may change by this [rad]; a hydrant may turn all the way round.
        samples: Placements that are drawn.
        steps: Evaluations of each.
        colour_rate: Adam's step of the colours before squashing.
        colours: Whether colours are searched for too; else the objects are moved in their plain ones.
    """

    move_m: float = 1.5
    turn_rad: float = 0.6
    samples: int = 5
    steps: int = 10
    colour_rate: float = 0.5
    colours: bool = True

    def __post_init__(self) -> None:
        reach = (self.move_m, self.turn_rad)
        if (
            not all(np.isfinite(each) and each >= 0.0 for each in reach)
            or self.samples < 1
            or self.steps < 1
            or not self.colour_rate > 0.0
        ):
            raise ValueError(
                f"expected moves and turns of at least zero, and at least one sample and step at a rate above zero, got {self}"
            )


def bounds_of(things: Sequence[PlacedObject], settings: PoseSettings) -> list[PoseBounds]:
    """Where each object may stand: about its place in the world's configuration, at its size."""
    found = []
    for thing in things:
        turn_rad = np.pi if thing.kind == "hydrant" else settings.turn_rad
        x, y, yaw = (
            (at - reach, at + reach)
            for at, reach in ((thing.x_m, settings.move_m), (thing.y_m, settings.move_m), (thing.yaw_rad, turn_rad))
        )
        found.append(PoseBounds(x_m=x, y_m=y, yaw_rad=yaw))
    return found


def lanes_of(experiment: Experiment) -> KeepOut:
    """All lanes: no object may stand in one, also where nobody drives, as it stands at the height of the pavement."""
    return KeepOut(tuple(as_path(lane) for lane in experiment.site.lanes), experiment.site.off_track_m)


def random_placements(
    experiment: Experiment, count: int, seed: int, settings: PoseSettings | None = None
) -> list[tuple[VoxelGridObject, ...]]:
    """The objects at random allowed places, ``count`` times."""
    if not count:
        return []
    bounds = bounds_of(experiment.world.objects, settings or PoseSettings())
    surrogate = surrogate_of(experiment, placed_objects(experiment))
    scenes = randomly_placed(surrogate, bounds, lanes_of(experiment), count, seed)
    return [tuple(each for each in scene.objects if isinstance(each, VoxelGridObject)) for scene in scenes]


def pose_cell(
    experiment: Experiment, victim: LoadedPolicy, scenario: str, method: PoseMethod, seed: int, folder: Path, report: Report,
    scene: DeploymentScene, settings: PoseSettings | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Search for places and colours in the learned scene, drive in both domains, and keep the result in ``folder``.

    Args:
        experiment: Its scene and objects must be there.
        victim: Who is attacked.
        scenario: Drive: straight, right or left.
        method: ``none`` leaves the objects plain where they stand; ``random`` and ``gradient`` search at equal evaluations.
        seed: Of the search and its starts.
        folder: Where the search state and the result are kept.
        report: Told the finished fraction.
        scene: Where it is deployed.
        settings: Bounds and budget.

    Returns:
        The cell as JSON data, as `cells.run_cell` gives it; ``extra.placements`` has x [m], y [m], yaw [rad] and scale of each
        object, ``extra.colours`` their colours before squashing.
    """
    settings = settings or PoseSettings()
    frozen = pose_hash(experiment, victim, scenario, seed, settings)
    result = folder / f"poses_{scenario}_{method}_{seed}.cell.json"
    if result.exists() and (kept := json.loads(result.read_text()))["settings_hash"] == frozen:
        return dict(kept)
    objects = placed_objects(experiment)
    surrogate = surrogate_of(experiment, objects)
    problem = attack_problem(experiment, surrogate, victim, scenario, seed)
    clean, blocked = _driven(experiment, problem, scene, surrogate, objects, surrogate.plain_theta(), scenario)
    attacked, extra, state = clean, {}, result.with_suffix(".state.safetensors")
    if method != "none":
        found = _search(experiment, problem, method, seed, settings, state, frozen, report)
        attacked, blocked = _driven(
            experiment, problem, scene, surrogate.with_objects(found.objects), found.objects, found.colours, scenario
        )
        extra = _told(found)
    data = {
        "scenario": scenario, "victim": victim.sha256, "method": method, "seed": seed, "attack_id": None, "settings_hash": frozen,
        "machine": machine_name(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        **{domain: {**attacked[domain], "none_total_cte_m": clean[domain]["total_cte_m"]} for domain in clean},
        "extra": {**extra, "blocked_tick": blocked},
    }  # fmt: skip
    write_atomically(result, json.dumps(data, indent=1) + "\n")
    state.unlink(missing_ok=True)
    return data


def found_objects(experiment: Experiment, extra: dict[str, Any]) -> Sequence[VoxelGridObject]:
    """The objects where a finished cell has put them, of its ``extra``; where they were placed by hand without an attack."""
    objects = placed_objects(experiment)
    if "placements" not in extra:
        return objects
    return placed(objects, torch.tensor(extra["placements"], dtype=torch.float64))


def found_colours(extra: dict[str, Any], dressed: DressedScene) -> Tensor:
    """Their colours before squashing; plain without an attack."""
    plain = dressed.plain_theta()
    return torch.tensor(extra["colours"], dtype=plain.dtype) if "colours" in extra else plain


def pose_hash(experiment: Experiment, victim: LoadedPolicy, scenario: str, seed: int, settings: PoseSettings) -> str:
    """Hash of what a cell depends on, whatever its method."""
    attack = experiment.config.attack
    return hash_of({
        **frozen_objects(experiment), "scene": scene_sha256(experiment), "victim": victim.sha256, "settings": asdict(settings),
        "starts": experiment.start_states(scenario, seed).tolist(), "sigma": attack.random_sigma,
        "limits": asdict(experiment.limits), "site": experiment.site.settings,
    })  # fmt: skip


def _search(
    experiment: Experiment, problem: AttackProblem, method: Literal["random", "gradient"], seed: int, settings: PoseSettings,
    state: Path, settings_hash: str, report: Report,
) -> FoundPoses:  # fmt: skip
    budget = MultiStart(settings.samples, settings.steps, colour_rate=settings.colour_rate)
    return pose_attack(
        problem, bounds_of(experiment.world.objects, settings), lanes_of(experiment), method, budget, seed,
        settings.colours, sigma=experiment.config.attack.random_sigma, state_path=state, settings_hash=settings_hash,
        on_evaluation=telling(budget.evaluations, report, f"{method} "),
    )  # fmt: skip


def _driven(
    experiment: Experiment, problem: AttackProblem, scene: DeploymentScene, surrogate: Surrogate,
    objects: Sequence[VoxelGridObject], colours: Tensor, scenario: str,
) -> tuple[dict[str, dict[str, Any]], list[int | None]]:  # fmt: skip
    """Drives from all starts of a problem past objects, in the learned scene and where they are deployed, and where these ran into something."""
    _, learned = learned_drives(experiment, replace(problem, sensor=surrogate), colours)
    dressed = DressedScene(scene, experiment.view, objects)
    deployed = deployed_drives(experiment, dressed, problem.policy, scenario, problem.start_states, colours)
    both = {"surrogate": totals(learned), "deployed": totals([drive.metrics for drive in deployed])}
    return both, [drive.blocked_tick for drive in deployed]


def _told(found: FoundPoses) -> dict[str, Any]:
    history = found.search.history
    return {
        "placements": found.placements.tolist(), "colours": found.colours.tolist(), "evaluations": len(history),
        "curve_total_cte_m": [evaluation.predicted_total_cte_m for evaluation in history],
        "seconds": round(sum(evaluation.seconds for evaluation in history), 1),
    }  # fmt: skip
