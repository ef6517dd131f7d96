"""Allowed placements of objects: bounds of each object's place, and the lane that must stay free.

A search sees the unit box: a coordinate of -1 is the lower bound of an axis, 1 the upper. It stays inside by projection, not by a squash:
a squash's slope vanishes at the bounds, where many good poses lie, and cannot represent the lane. A step that leads out of the
box is cut off at its border (a heading that may turn all the way round wraps around); an object that then stands on the
lane is pushed sideways off it, and if that fails the step is shortened until the object stands clear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from advnerf_core.driving.path import Path
from advnerf_core.errors import AdvnerfError
from advnerf_core.fields.voxel_grid import VoxelGridObject
from advnerf_core.geometry import Array, rotation_z, yaw_of
from advnerf_core.render.cast_object import prepared
from advnerf_core.render.soft_pose import placed_at, placement_of

AXES = ("x_m", "y_m", "yaw_rad", "scale")
Interval = tuple[float, float]
# Points of a path have this spacing: the distance to a straight between two of them is off by less than 1 mm beyond 0.3 m.
_PATH_SPACING_M = 0.05
_TRIES, _PUSHES, _HALVINGS = 1000, 8, 12


class PoseBoundsError(AdvnerfError, ValueError):
    """Invalid pose bounds, or bounds that leave no place beside the lane."""


@dataclass(frozen=True)
class PoseBounds:
    """Allowed placements of one object; an axis that is None is fixed.

    Attributes:
        x_m: Lowest and highest x of the object's origin [m].
        y_m: Lowest and highest y [m].
        yaw_rad: Interval of the heading [rad]; a whole turn or more is unbounded.
        scale: Interval of the world metres per object unit.
    """

    x_m: Interval | None = None
    y_m: Interval | None = None
    yaw_rad: Interval | None = None
    scale: Interval | None = None

    def __post_init__(self) -> None:
        """Raise for an empty interval."""
        for name in AXES:
            interval = getattr(self, name)
            if interval is not None and not (
                len(interval) == 2 and np.isfinite(interval).all() and interval[0] <= interval[1]
            ):
                raise PoseBoundsError(f"{name}: expected finite bounds, lower before upper, got {interval}")
        if self.scale is not None and self.scale[0] <= 0.0:
            raise PoseBoundsError(f"scale: expected bounds above 0, got {self.scale}")


@dataclass(frozen=True, eq=False)
class KeepOut:
    """The driven lane, where no object may stand.

    Attributes:
        paths: Reference paths of all drives.
        clearance_m: Least distance of an object's footprint from each of them [m]; half a lane keeps the lane free.
    """

    paths: tuple[Path, ...]
    clearance_m: float
    _points: Array = field(init=False, repr=False, default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        """Lay points along the paths."""
        if not 0.0 <= self.clearance_m < np.inf:
            raise PoseBoundsError(f"expected a clearance >= 0 m from the path, got {self.clearance_m}")
        along = [
            path.pose_at(np.linspace(0.0, path.length_m, 2 + int(path.length_m / _PATH_SPACING_M)))[:, :2]
            for path in self.paths
        ]
        object.__setattr__(self, "_points", np.concatenate([np.zeros((0, 2)), *along]))

    def distance_m(self, placement: ArrayLike, rectangle: tuple[Array, Array]) -> float:
        """Distance of an object's footprint from the nearest path, negative if a path runs through it [m].

        Args:
            placement: ``(x_m, y_m, yaw_rad, scale)``.
            rectangle: The object's `footprint`.
        """
        if not len(self._points):
            return float(np.inf)
        x, y, yaw, scale = np.asarray(placement, dtype=np.float64)
        low, high = (scale * corner for corner in rectangle)
        points = (self._points - [x, y]) @ rotation_z(yaw)[:2, :2]
        beyond = np.abs(points - 0.5 * (low + high)) - 0.5 * (high - low)
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return float((outside + np.minimum(beyond.max(axis=1), 0.0)).min())

    def away(self, xy_m: Array) -> Array:
        """Unit vector ``[2]`` from the nearest point of a path to a position."""
        offset = xy_m - self._points[np.argmin(np.sum((self._points - xy_m) ** 2, axis=1))]
        length = float(np.linalg.norm(offset))
        return np.asarray(offset / length if length > 1e-9 else np.array([1.0, 0.0]))


def footprint(field: VoxelGridObject) -> tuple[Array, Array]:
    """Corners ``[2]`` of the bounding rectangle of an object's non-empty part, seen from above, in axes that turn with its yaw.

    They are in object units: an object of scale 2 covers twice as many metres.
    """
    grids = prepared(field, np.float32)
    T = field.T_world_from_object
    corners = (
        np.array(np.meshgrid(*np.stack([grids.low, grids.high], axis=1), indexing="ij")).reshape(3, -1).T
    )
    xy = (corners @ (rotation_z(-yaw_of(T)) @ T[:3, :3]).T)[:, :2]
    return xy.min(axis=0), xy.max(axis=0)


def placed(objects: Sequence[VoxelGridObject], placements: Tensor) -> tuple[VoxelGridObject, ...]:
    """The objects at ``placements [K, 4]`` (x [m], y [m], yaw [rad], scale); they keep height and tilt."""
    if placements.shape != (len(objects), 4):
        raise ValueError(f"expected placements [{len(objects)}, 4], got {list(placements.shape)}")
    return tuple(placed_at(each, placement) for each, placement in zip(objects, placements, strict=True))


class PoseSpace:
    """All allowed placements of some objects.

    Args:
        objects: The objects where they stand now.
        keep_out: Lanes that must stay free; None allows everything within the bounds.

    Raises:
        PoseBoundsError: The number of bounds differs from the number of objects.
    """

    def __init__(
        self,
        objects: Sequence[VoxelGridObject],
        bounds: Sequence[PoseBounds],
        keep_out: KeepOut | None = None,
    ) -> None:
        if len(bounds) != len(objects) or not objects:
            raise PoseBoundsError(f"expected bounds for each of {len(objects)} object(s), got {len(bounds)}")
        self.objects, self.bounds, self.keep_out = tuple(objects), tuple(bounds), keep_out
        self._footprints = [footprint(each) for each in objects]
        self.nominal = torch.stack([placement_of(each) for each in objects])
        limits = np.empty((len(objects), 4, 2))
        for k, bound in enumerate(bounds):
            for axis, name in enumerate(AXES):
                limits[k, axis] = getattr(bound, name) or (self.nominal[k, axis], self.nominal[k, axis])
        self.middle = torch.from_numpy(limits.mean(axis=2))
        self._lowest, self._highest = (
            torch.from_numpy(limits[..., 0].copy()),
            torch.from_numpy(limits[..., 1].copy()),
        )
        self.half = torch.from_numpy(0.5 * (limits[..., 1] - limits[..., 0]))
        self._turns = self.half[:, 2] >= np.pi
        self.half[:, 2] = self.half[:, 2].clamp(max=np.pi)

    def placements(self, unit: Tensor) -> Tensor:
        """Placements ``[K, 4]`` of coordinates ``[K, 4]``; within the bounds to the last bit if these are in the unit box."""
        placements = self.middle + self.half * unit.double()
        return torch.where(unit.abs() <= 1.0, placements.clamp(self._lowest, self._highest), placements)

    def unit(self, placements: Tensor) -> Tensor:
        """Coordinates ``[K, 4]`` of placements; 0 along an axis that is fixed.

        Raises:
            PoseBoundsError: A placement out of bounds, or on the lane.
        """
        offset = placements.double() - self.middle
        offset[:, 2] = torch.where(
            self._turns, torch.remainder(offset[:, 2] + np.pi, 2 * np.pi) - np.pi, offset[:, 2]
        )
        unit = torch.where(self.half > 0.0, offset / self.half.clamp_min(1e-300), torch.zeros_like(offset))
        # A search ends on its bounds, and division may lead one bit beyond.
        within = unit.clamp(-1.0, 1.0)
        if bool((offset.abs() > self.half + 1e-9).any()) or not self.allows(within):
            raise PoseBoundsError(
                f"expected placements within the bounds and clear of the lane, got {placements.tolist()}"
            )
        return within

    def allows(self, unit: Tensor) -> bool:
        """Whether coordinates lie in the unit box, and all objects stand clear of the lane."""
        return bool((unit.abs() <= 1.0).all()) and self.clear(self.placements(unit))

    def clear(self, placements: Tensor) -> bool:
        """Whether objects at ``placements [K, 4]``, within the bounds or not, all stand clear of the lane."""
        lane = self.keep_out
        return lane is None or all(
            lane.distance_m(place.numpy(), rectangle) >= lane.clearance_m
            for place, rectangle in zip(placements.detach().double(), self._footprints, strict=True)
        )

    def draw(self, generator: torch.Generator) -> Tensor:
        """Coordinates ``[K, 4]`` drawn evenly from what is allowed.

        Raises:
            PoseBoundsError: No allowed place is found for an object.
        """
        unit = torch.zeros(len(self.objects), 4, dtype=torch.float64)
        for k in range(len(self.objects)):
            for _ in range(_TRIES):
                unit[k] = 2.0 * torch.rand(4, generator=generator, dtype=torch.float64) - 1.0
                unit[k] *= (self.half[k] > 0.0).double()
                if self._clear(k, unit[k]):
                    break
            else:
                assert self.keep_out is not None
                raise PoseBoundsError(
                    f"object {k}: expected bounds with a place at least {self.keep_out.clearance_m} m beside the path, found none in "
                    f"{_TRIES} tries; widen x_m and y_m ({self.bounds[k]}), or lower the clearance"
                )
        return unit

    def project(self, unit: Tensor, before: Tensor) -> Tensor:
        """Projects a step from allowed coordinates ``before`` to ``unit``; the result is always allowed."""
        out = before.clone()
        for k in range(len(self.objects)):
            out[k] = self._projected(k, unit[k].double(), before[k])
        return out

    def _projected(self, k: int, unit: Tensor, before: Tensor) -> Tensor:
        wanted = self._boxed(k, unit)
        if self._clear(k, wanted):
            return wanted
        pushed = self._pushed(k, wanted)
        if self._clear(k, pushed):
            return pushed
        share = 1.0
        for _ in range(_HALVINGS):
            share *= 0.5
            shorter = self._boxed(k, before + share * (wanted - before))
            if self._clear(k, shorter):
                return shorter
        return before

    def _boxed(self, k: int, unit: Tensor) -> Tensor:
        boxed = unit.clamp(-1.0, 1.0)
        if self._turns[k]:
            boxed[2] = torch.remainder(unit[2] + 1.0, 2.0) - 1.0
        return boxed

    def _pushed(self, k: int, unit: Tensor) -> Tensor:
        """Moved straight away from the nearest path, by the missing distance, within the box."""
        assert self.keep_out is not None
        free = self.half[k, :2] > 0.0
        for _ in range(_PUSHES):
            missing = self.keep_out.clearance_m - self._distance_m(k, unit)
            if missing <= 0.0 or not bool(free.any()):
                break
            away = torch.from_numpy(self.keep_out.away(self._placement(k, unit)[:2].numpy()))
            unit = unit.clone()
            unit[:2] += torch.where(
                free, 1.001 * (missing + 1e-6) * away / self.half[k, :2].clamp_min(1e-300), 0.0
            )
            unit = self._boxed(k, unit)
        return unit

    def _clear(self, k: int, unit: Tensor) -> bool:
        return self.keep_out is None or self._distance_m(k, unit) >= self.keep_out.clearance_m

    def _distance_m(self, k: int, unit: Tensor) -> float:
        assert self.keep_out is not None
        return self.keep_out.distance_m(self._placement(k, unit).numpy(), self._footprints[k])

    def _placement(self, k: int, unit: Tensor) -> Tensor:
        return self.middle[k] + self.half[k] * unit
