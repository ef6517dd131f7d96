"""Pose attacks of a request: the search and its attack file; resumable in their folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem, BlackBoxError, evaluate
from advnerf_core.attack.artifact import PLACES, AttackFile, load_attack, save_attack
from advnerf_core.attack.methods import SearchRun
from advnerf_core.attack.pose_plots import draw_placements
from advnerf_core.attack.search.poses import MultiStart, judge, multi_start, placed_problem, random_poses
from advnerf_core.attack.search.record import SearchResult
from advnerf_core.attack.spaces.placed_sensor import PlacedSensor
from advnerf_core.attack.spaces.placement import KeepOut, PoseBounds, PoseSpace, placed
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.files import write_atomically, write_json
from advnerf_core.render.soft_pose import placement_of
from nodes.experiment.engine.artefact import hash_of
from nodes.experiment.engine.telling import telling
from nodes.experiment.node.pose_request import PosesRequest
from nodes.experiment.node.prepare import Prepared, prepare
from nodes.experiment.node.request import AttackRequest
from nodes.experiment.node.search import attack_file, keep_request
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import StageDisplay

Report = Callable[[float, str], None]


@dataclass(frozen=True, eq=False)
class PreparedPoses:
    """A pose attack, ready to be searched for.

    Attributes:
        prepared: The attack with its objects where the request has them.
        asked: The key ``poses`` of the request.
        problem: With a `PlacedSensor`.
    """

    prepared: Prepared
    asked: PosesRequest
    problem: AttackProblem

    @property
    def sensor(self) -> PlacedSensor:
        """Its sensor."""
        assert isinstance(self.problem.sensor, PlacedSensor)
        return self.problem.sensor

    @property
    def settings_hash(self) -> str:
        """Names everything that must not change between a search and its resumption, or a map and its file."""
        return hash_of(
            [self.prepared.hashes, self.asked.model_dump(mode="json", include={"colours", "edge_width"})]
        )

    def with_seed(self, seed: int) -> PreparedPoses:
        """The same with another seed."""
        prepared = self.prepared.with_seed(seed)
        return replace(self, prepared=prepared, problem=replace(prepared.problem, sensor=self.sensor))

    def theta_of(self, file: Path) -> Tensor:
        """The sensor's theta of an attack file of this request's objects.

        Raises:
            ConfigError: It has other objects.
        """
        placements, colours = placements_and_colours(file, self.sensor)
        space = self.sensor.space
        unit = torch.where(space.half > 0, (placements - space.middle) / space.half.clamp_min(1e-300), 0.0)
        if (space.placements(unit) - placements)[:, [0, 1, 3]].abs().max() > 1e-6:
            raise ConfigError(
                f"{file}: expected objects that stand within the bounds of the request, got {placements.tolist()}"
            )
        if not self.asked.colours and not torch.allclose(colours, self.sensor.fixed_colours):
            raise ConfigError(
                f"{file}: expected the colours of the request (poses.attack, or plain ones), got others"
            )
        return self.sensor.join(unit, colours)


def prepare_poses(request: AttackRequest, seed: int | None = None) -> PreparedPoses:
    """Load everything a pose attack needs.

    Raises:
        ConfigError: No key ``poses``, or something of the request that poses do not go with.
        PoseBoundsError: Bounds that are none.
    """
    asked = _checked(request)
    prepared = prepare(request, seed)
    bounds = [PoseBounds(each.x_m, each.y_m, each.yaw_rad, each.scale) for each in asked.bounds]
    lane = KeepOut((prepared.problem.path,), asked.keep_out_m)
    space = PoseSpace(
        [each.field for each in prepared.objects if isinstance(each.field, VoxelGridObject)], bounds, lane
    )
    sensor = PlacedSensor(prepared.surrogate, space, asked.colours, edge_width=asked.edge_width)
    if asked.attack is not None:
        _, colours = placements_and_colours(asked.attack, sensor)
        sensor = PlacedSensor(prepared.surrogate, space, False, colours, asked.edge_width)
        digest = [prepared.hashes["config"], load_attack(asked.attack).sha256]
        prepared = replace(prepared, hashes={**prepared.hashes, "config": hash_of(digest)})
    return PreparedPoses(prepared, asked, replace(prepared.problem, sensor=sensor))


def _checked(request: AttackRequest) -> PosesRequest:
    asked = request.poses
    if asked is None:
        raise ConfigError(
            "expected the key poses in the request, with bounds of each object; see docs/poses.md"
        )
    if request.search.method not in ("gradient", "random"):
        raise ConfigError(
            f"search.method: expected gradient or random for poses, got {request.search.method_name}"
        )
    if request.search.together or request.robustness.smoothness or any(o.display for o in request.objects):
        raise ConfigError("poses: expected no search.together, robustness.smoothness or display with them")
    if asked.colours and asked.attack is not None:
        raise ConfigError(
            "poses.attack: expected colours: false with it; it gives colours that are not searched for"
        )
    for bound, each in zip(asked.bounds, request.objects, strict=True):
        if bound.scale is not None and each.kind != "file":
            raise ConfigError(
                f"poses: expected no bounds of the scale of a {each.kind}, which is as large as its board"
            )
    return asked


def placements_and_colours(file: Path, sensor: PlacedSensor) -> tuple[Tensor, Tensor]:
    """Placements ``[K, 4]`` and colours (of the surrogate's ``theta_shape``) that an attack file holds.

    Raises:
        AttackFileError: No attack file.
        ConfigError: It has other objects.
    """
    attack, fields = load_attack(file), sensor.space.objects
    parts = [each.theta for each in attack.objects]
    shapes, expected = [part.shape for part in parts], [tuple(field.theta_shape) for field in fields]
    if shapes != expected:
        raise ConfigError(
            f"{file}: expected colours of shapes {expected} for the objects of the request, got {shapes}"
        )
    moved = [
        f.moved(each.T_world_from_object, each.scale) for f, each in zip(fields, attack.objects, strict=True)
    ]
    colours = torch.cat([torch.from_numpy(part).double().reshape(-1, 3) for part in parts])
    return torch.stack([placement_of(each) for each in moved]), colours.reshape(sensor.surrogate.theta_shape)


def search_poses(
    ready: PreparedPoses, state_path: Path | None = None, report: Report = lambda fraction, text: None
) -> SearchResult:
    """Search as the request asks: multi-start for the method gradient, random poses at as many evaluations for random."""
    problem, asked = ready.problem, ready.asked
    told = telling(asked.evaluations, report, ready.prepared.clean_drive, problem.objective)
    run = SearchRun(ready.prepared.seed, state_path, told, ready.settings_hash)
    if ready.prepared.request.search.method == "random":
        sigma = ready.prepared.request.search.sigma or 5.0
        return random_poses(problem, asked.evaluations, sigma, run)
    if not problem.differentiable:
        raise BlackBoxError(f"{ready.prepared.request.policy} has no gradient: use the method random")
    budget = MultiStart(asked.samples, asked.steps, asked.pose_rate, asked.colour_rate)
    return multi_start(problem, budget, run)


def pose_attack_file(ready: PreparedPoses, result: SearchResult) -> AttackFile:
    """The attack file: objects at the found poses; its prediction is made without disturbances."""
    surrogate, colours = ready.sensor.sharp(result.theta)
    moved_fields = placed(ready.sensor.space.objects, ready.sensor.placements(result.theta))
    totals = judge(ready.problem, result.theta)
    objects = tuple(
        replace(each, field=moved, sha256=moved.sha256)
        for each, moved in zip(ready.prepared.objects, moved_fields, strict=True)
    )
    prepared = replace(ready.prepared, surrogate=surrogate, objects=objects)
    # Without an attack the objects stand where the request has them, in their plain colours.
    file = prepared.make_attack_file(replace(result, theta=colours), totals, ready.prepared.clean_drive)
    extra = {
        **file.extra,
        "colours_free": ready.asked.colours,
        "keep_out_m": ready.asked.keep_out_m,
        "searched_total_cte_m": result.best.predicted_total_cte_m,
    }
    return replace(file, space=PLACES, extra=extra)


def run_poses(request: AttackRequest, folder: Path, display: StageDisplay) -> list[Path]:
    """Run every seed of a pose attack in a folder, going on where it was stopped.

    Returns:
        The attack files, each with its curve (JSON) and a picture of the poses beside it.
    """
    keep_request(request, folder)
    ready, files = None, [attack_file(folder, seed) for seed in request.search.seeds]
    for seed, file in zip(request.search.seeds, files, strict=True):
        name = f"seed_{seed}"
        if file.exists():
            display.finish(name, 0.0, cached=True)
            continue
        ready = prepare_poses(request, seed) if ready is None else ready.with_seed(seed)
        state = folder / f"seed_{seed}.state.safetensors"
        result = search_poses(ready, state, display.start(name))
        _keep(ready, result, file)
        state.unlink(missing_ok=True)
        display.finish(name, sum(e.seconds for e in result.history), cached=False)
    return files


def _keep(ready: PreparedPoses, result: SearchResult, file: Path) -> None:
    sharp, colours = placed_problem(ready.problem.undisturbed(), result.theta)
    before = replace(sharp, sensor=ready.sensor.surrogate)
    plain = ready.sensor.surrogate.plain_theta()
    drives = {
        ready.prepared.request.search.method: evaluate(sharp, colours)[0],
        "none": evaluate(before, plain)[0],
    }
    tracks = {name: rollout.states[:, 0, :2].numpy() for name, rollout in drives.items()}
    picture = draw_placements(
        ready.sensor.space, ready.sensor.placements(result.theta), [ready.problem.path], tracks
    )
    write_atomically(file.with_name(f"seed_{ready.prepared.seed}.poses.png"), picture)
    attack = pose_attack_file(ready, result)
    curve = {
        "attack_id": attack.attack_id,
        "method": attack.method,
        "seed": attack.seed,
        "best_evaluation": result.best.iteration,
        "predicted_total_cte_m": attack.predicted_total_cte_m,
        "clean_drive": ready.prepared.clean_drive.to_dict(),
        "placements": [each.placement for each in attack.objects],
        "searched_total_cte_m": [e.predicted_total_cte_m for e in result.history],
        "seconds": [e.seconds for e in result.history],
    }
    write_json(file.with_name(f"seed_{ready.prepared.seed}.json"), curve)
    save_attack(file, attack)  # last: a file that is there is a finished seed
