"""Places of an attack's objects in a world, as listed in an experiment file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Discriminator, Field, Tag

from advnerf_core.geometry import Array, make_transform, rotation_z
from advnerf_core.strict import StrictModel
from hardware.worlds.paths import ReferencePath
from hardware.worlds.world import WorldDescription
from nodes.experiment.plan.object_kinds import ObjectKind, footprint_m

_SPACING_M = 0.05  # of the points that stand for a lane's middle


class PlacedObject(StrictModel):
    """Place of an object of the attack. It is not part of the world: the deployment composes it by depth.

    Attributes:
        name: Unique name.
        kind: What it is: small_car, hydrant, panel, or a file of a user's, see `object_kinds`.
        x_m: Middle of its foot [m].
        y_m: Middle of its foot [m].
        z_m: Height of the ground under it [m]: the kerb's on a pavement.
        yaw_rad: Heading of its front [rad]; a panel shows its texture there.
        scale: Size relative to the object as it was built.
    """

    name: str = Field(min_length=1)
    kind: ObjectKind
    x_m: float
    y_m: float
    z_m: float = 0.0
    yaw_rad: float = 0.0
    scale: float = Field(default=1.0, gt=0.0, le=2.0)

    @property
    def side_m(self) -> float:
        """Width [m]; of a panel also its height."""
        return self.scale * footprint_m(self.kind)[1]

    @property
    def T_world_from_face(self) -> Array:
        """Pose ``[4, 4]`` of a panel's face: its middle, x out of it, z up."""
        middle = [self.x_m, self.y_m, self.z_m + 0.5 * self.side_m]
        return make_transform(rotation_z(self.yaw_rad), middle)

    @property
    def T_world_from_object(self) -> Array:
        """Pose ``[4, 4]`` of its foot, x to its front, z up; the scale is not part of it."""
        return make_transform(rotation_z(self.yaw_rad), [self.x_m, self.y_m, self.z_m])

    def corners_m(self) -> list[tuple[float, float]]:
        """The four corners [m] of the ground it covers."""
        length, width = (0.5 * self.scale * size for size in footprint_m(self.kind))
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
        ends = [(a * length, b * width) for a, b in signs]
        return [(self.x_m + c * u - s * v, self.y_m + s * u + c * v) for u, v in ends]


class FirstSeen(StrictModel):
    """A rule for the place of an object: the first spot beside a path where it fits and is visible; see `nodes.experiment.show.placing`.

    Attributes:
        path: The path; None for the experiment's first.
        side: Side of the path.
        seen_s: Time for which a drive along the path sees nearly all of it, unhidden and from the front [s].
        least_px: Smallest height in the policy's picture during that time [px].
    """

    path: str | None = None
    side: Literal["right", "left", "either"] = "either"
    seen_s: float = Field(default=2.0, gt=0.0)
    least_px: float = Field(default=8.0, gt=0.0)


class RuledObject(StrictModel):
    """An object that a rule places while the world is photographed.

    Attributes:
        name: Unique name.
        kind: Kind of object: a panel.
        z_m: Height of the ground under it [m].
        scale: Size relative to the object as built.
        stands: The rule.
    """

    name: str = Field(min_length=1)
    kind: Literal["panel"]
    z_m: float = 0.0
    scale: float = Field(default=1.0, gt=0.0, le=2.0)
    stands: FirstSeen

    def at(self, x_m: float, y_m: float, yaw_rad: float) -> PlacedObject:
        """The object at one place, rounded to the millimetre, so that no machine's last bit moves it."""
        return PlacedObject(
            name=self.name,
            kind=self.kind,
            x_m=round(x_m, 3),
            y_m=round(y_m, 3),
            z_m=self.z_m,
            yaw_rad=round(yaw_rad, 3),
            scale=self.scale,
        )


def _by_rule(value: Any) -> str:
    found = isinstance(value, RuledObject) or (isinstance(value, Mapping) and "stands" in value)
    return "by rule" if found else "by hand"


WantedObject = Annotated[
    Annotated[PlacedObject, Tag("by hand")] | Annotated[RuledObject, Tag("by rule")], Discriminator(_by_rule)
]


def in_a_lane(objects: Sequence[PlacedObject], world: WorldDescription) -> tuple[int, str] | None:
    """The first object that reaches into a lane, nearer than half a lane's width to its middle.

    Returns:
        The object's index, and a description of the problem; None if all objects stand beside the lanes.
    """
    middles = np.concatenate([_middle_of(lane) for lane in world.lanes])
    for index, thing in enumerate(objects):
        turned, half = (
            rotation_z(thing.yaw_rad)[:2, :2],
            0.5 * thing.scale * np.array(footprint_m(thing.kind)),
        )
        seen_from_it = (middles - [thing.x_m, thing.y_m]) @ turned
        nearest = np.clip(seen_from_it, -half, half)  # within the ground that it covers
        distance_m = np.linalg.norm(seen_from_it - nearest, axis=1)
        at = int(distance_m.argmin())
        if distance_m[at] < world.off_track_m:
            x, y = turned @ nearest[at] + [thing.x_m, thing.y_m]
            return index, (
                f"expected objects beside the lanes, at least {world.off_track_m:g} m from their middles, but {thing.name} reaches into a lane "
                f"at ({x:.2f}, {y:.2f}); move it"
            )
    return None


@lru_cache(maxsize=64)  # many spots are tried with a few lanes
def _middle_of(lane: ReferencePath) -> Array:
    """Points ``[N, 2]`` along the middle of a lane."""
    along_m = np.linspace(0.0, lane.length_m, 2 + int(lane.length_m / _SPACING_M))
    return np.array([lane.pose_at(float(s))[:2] for s in along_m])
