"""The space of places: objects' positions beside the lanes, alone or together with their colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from advnerf_core.attack.artifact import PLACES, AttackedObject, AttackFile
from advnerf_core.attack.methods import SearchRun, SearchSettings
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.attack.search.poses import MultiStart, multi_start, random_poses
from advnerf_core.attack.search.record import SearchResult
from advnerf_core.attack.spaces.placed_sensor import PlacedSensor
from advnerf_core.attack.spaces.placement import KeepOut, PoseBounds, PoseSpace, placed
from advnerf_core.attack.spaces.space import (
    FaceMount,
    NamedObject,
    Shown,
    SpaceError,
    attacked_object,
    colours_of,
    require_same,
)
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.scene.surrogate import Surrogate, split_theta

METHODS = ("random", "gradient")


@dataclass(frozen=True)
class PlaceLimits:
    """Limits of the objects' places.

    Attributes:
        keep_out: Lanes that stay free; None allows everything within the bounds.
        colours: Whether colours are searched too; else the objects keep their own.
        kept_colours: Those that they keep, in the surrogate's ``theta_shape``; None for their plain ones.
        edge_width: Width of the soft edges, see `PlacedSensor`.
    """

    bounds: Sequence[PoseBounds]
    keep_out: KeepOut | None
    colours: bool = True
    kept_colours: Tensor | None = None
    edge_width: float | None = None


class PlaceSpace:
    """Places of voxel objects; its methods are ``gradient`` (several drawn placements, each refined) and ``random``.

    Args:
        surrogate: The scene with the objects where they stand without an attack.
        named: What attack files say of them, in their order.
        mount: What shows the texture of one of them.

    Raises:
        PoseBoundsError: Not one bound for each object, or bounds that leave no place beside the lanes.
        SpaceError: An object that is not made of voxels.
    """

    name = PLACES

    def __init__(
        self,
        surrogate: Surrogate,
        named: Sequence[NamedObject],
        limits: PlaceLimits,
        budget: MultiStart,
        mount: FaceMount | None = None,
    ) -> None:
        self.surrogate, self._named, self._budget, self.mount = surrogate, tuple(named), budget, mount
        self._fields = [each for each in surrogate.objects if isinstance(each, VoxelGridObject)]
        if len(self._fields) != len(surrogate.objects):
            raise SpaceError(
                "expected objects made of voxels, got a mesh: only voxels are differentiable in their pose"
            )
        self.sensor = PlacedSensor(
            surrogate,
            PoseSpace(self._fields, limits.bounds, limits.keep_out),
            limits.colours,
            limits.kept_colours,
            limits.edge_width,
        )

    @property
    def plain(self) -> Shown:
        """The objects at their places without an attack, in their own colours."""
        return Shown(self.surrogate.objects, self.surrogate.plain_theta())

    def search(
        self, method: str, problem: AttackProblem, settings: SearchSettings, run: SearchRun
    ) -> SearchResult:
        """Search places with the space's budget; see `Space.search`."""
        if method not in METHODS:
            raise SpaceError(f"expected a method that searches places, {' or '.join(METHODS)}, got {method}")
        if method == "gradient":
            return multi_start(problem, self._budget, run)
        sigma = settings.sigma or settings.random_sigma
        return random_poses(problem, self._budget.evaluations, sigma, run)

    def attacked(self, theta: Tensor) -> tuple[AttackedObject, ...]:
        """Each object at its place, with its colours."""
        colours = split_theta(self._fields, self.sensor.colours(theta).to(self.surrogate.dtype))
        rows = zip(self._named, placed(self._fields, self.sensor.placements(theta)), colours, strict=True)
        return tuple(attacked_object(*row) for row in rows)

    def restored(self, attack: AttackFile) -> Shown:
        """The objects at the places of the file; see `Space.restored`."""
        require_same(attack, self._named)
        moved = [
            field.moved(each.T_world_from_object, each.scale)
            for field, each in zip(self._fields, attack.objects, strict=True)
        ]
        return Shown(moved, colours_of(attack, self.surrogate.dtype))


def randomly_placed(
    objects: Sequence[VoxelGridObject], limits: PlaceLimits, count: int, seed: int = 0
) -> list[tuple[VoxelGridObject, ...]]:
    """The objects at ``count`` random allowed placements, for retraining a victim to tolerate moved objects.

    Raises:
        PoseBoundsError: Not one bound for each object, or bounds that leave no place beside the lanes.
    """
    space, generator = PoseSpace(objects, limits.bounds, limits.keep_out), torch.Generator().manual_seed(seed)
    return [placed(objects, space.placements(space.draw(generator))) for _ in range(count)]
