"""A pose attack from a surrogate's problem to what a deployment shows, in one call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from advnerf_core.attack.adjoint import AttackProblem, Totals
from advnerf_core.attack.search.poses import MultiStart, judge, multi_start, random_poses
from advnerf_core.attack.search.search import OnEvaluation, SearchResult
from advnerf_core.attack.spaces.placed_sensor import PlacedSensor
from advnerf_core.attack.spaces.placement import KeepOut, PoseBounds, PoseSpace, placed
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.scene.remembered import frame_bytes
from advnerf_core.scene.surrogate import Surrogate

Method = Literal["gradient", "random"]


@dataclass(frozen=True, eq=False)
class FoundPoses:
    """What a pose attack found.

    Attributes:
        placements: ``(x_m, y_m, yaw_rad, scale)`` of each object, ``[K, 4]``.
        colours: Of the surrogate's ``theta_shape``; its plain or given ones where they were not searched for.
        objects: The objects at these placements, with their true edges.
        totals: Total CTE of each start that the surrogate predicts for them.
        search: The search: its best evaluation and its history.
    """

    placements: Tensor
    colours: Tensor
    objects: tuple[VoxelGridObject, ...]
    totals: Totals
    search: SearchResult

    def deployed(self, surrogate: Surrogate) -> Surrogate:
        """A surrogate whose ``overlay(rgb, depth_m, poses, colours)`` puts opaque objects into a deployment's images."""
        return surrogate.with_objects(self.objects, opaque=True)


def pose_attack(
    problem: AttackProblem,
    bounds: Sequence[PoseBounds],
    keep_out: KeepOut | None,
    method: Method = "gradient",
    budget: MultiStart | None = None,
    seed: int = 0,
    free_colours: bool = True,
    colours: Tensor | None = None,
    sigma: float = 5.0,
    state_path: Path | None = None,
    on_evaluation: OnEvaluation | None = None,
    settings_hash: str = "",
) -> FoundPoses:
    """Search for poses, and colours if they are free, within bounds and beside the lane.

    Args:
        problem: What is attacked; its sensor must be a `Surrogate` with voxel-grid objects, where they stand now.
        bounds: Of each object.
        keep_out: The lane that stays free; None allows everything within the bounds.
        method: ``gradient`` refines drawn poses (`multi_start`), ``random`` only draws, at as many evaluations (`random_poses`).
        budget: Samples, steps and rates.
        seed: Of poses and colours.
        free_colours: Whether colours are searched for too.
        colours: The colours where they are not free; plain ones if not given.
        sigma: Spread of random colours before squashing.
        state_path: State file, written after every evaluation; if it exists, the search goes on from it.
        on_evaluation: Called after every evaluation.
        settings_hash: Hash of scene, policy and configuration; a state file of another one is refused.

    Raises:
        PoseBoundsError: Not one bound for each object, or bounds that leave no place beside the lane.
        SearchDivergedError: A loss or gradient is not finite.
        SearchStateError: The state file cannot be used.
    """
    surrogate, budget = problem.sensor, budget or MultiStart()
    if not isinstance(surrogate, Surrogate):
        raise TypeError(f"expected a problem with a Surrogate as sensor, got a {type(surrogate).__name__}")
    if method not in ("gradient", "random"):
        raise ValueError(f"expected the method gradient or random, got {method!r}")
    fields = [each for each in surrogate.objects if isinstance(each, VoxelGridObject)]
    if len(fields) < len(surrogate.objects):
        raise ValueError("expected objects made of voxels, got a mesh: only voxels are differentiable in their pose")
    # A gradient is of the frames that were driven past: the scene in them is not rendered a second time.
    one_evaluation = problem.steps * len(problem.start_states) * frame_bytes(surrogate.camera)
    surrogate = surrogate.remembering(min(one_evaluation, problem.cache_bytes))
    sensor = PlacedSensor(surrogate, PoseSpace(fields, bounds, keep_out), free_colours, colours)
    moving = replace(problem, sensor=sensor)
    if method == "gradient":
        result = multi_start(moving, budget, seed, state_path, on_evaluation, settings_hash)
    else:
        result = random_poses(moving, budget.evaluations, sigma, seed, state_path, on_evaluation, settings_hash)
    placements, found = sensor.placements(result.theta), sensor.colours(result.theta).to(surrogate.dtype)
    return FoundPoses(placements, found, placed(fields, placements), judge(moving, result.theta), result)


def randomly_placed(
    surrogate: Surrogate, bounds: Sequence[PoseBounds], keep_out: KeepOut | None, count: int, seed: int = 0
) -> list[Surrogate]:
    """The surrogate with its objects at ``count`` random allowed placements: what a victim is retrained on to bear moved objects.

    Args:
        surrogate: With voxel-grid objects.
        bounds: Of each object.
        keep_out: The lane that stays free.
        count: How many.
        seed: Of the placements.

    Raises:
        PoseBoundsError: Not one bound for each object, or bounds that leave no place beside the lane.
    """
    fields = [each for each in surrogate.objects if isinstance(each, VoxelGridObject)]
    space, generator = PoseSpace(fields, bounds, keep_out), torch.Generator().manual_seed(seed)
    return [surrogate.with_objects(placed(fields, space.placements(space.draw(generator)))) for _ in range(count)]
