"""Places of an attack's objects in a world, as listed in an experiment file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, Tag, field_validator, model_validator

from advnerf_core.files import is_plain_name
from advnerf_core.geometry import Array, make_transform, rotation_x, rotation_y, rotation_z
from advnerf_core.strict import Angle, StrictModel
from hardware.worlds.paths import ReferencePath
from hardware.worlds.world import WorldDescription
from nodes.experiment.plan.numbers import Length, Unit
from nodes.experiment.plan.object_kinds import (
    BALL,
    CUBE,
    MADE_HERE_M,
    MESH_SUFFIXES,
    OBJECT_SUFFIX,
    PANEL,
    UNITLESS_SUFFIXES,
    ObjectKind,
    extent_m,
    name_of,
)
from nodes.lab.located import NamedFile


def _plain(name: str) -> str:
    if not is_plain_name(name):
        raise ValueError("expected a name without slashes, as files are called by it")
    return name


ObjectName = Annotated[str, AfterValidator(_plain)]
Interval = tuple[float, float]
FLAT = (PANEL, CUBE)
_PLACE = {"name", "kind", "x_m", "y_m", "z_m", "yaw_rad", "scale"}
_OF_OWN_SCENES = {"pitch_rad", "roll_rad", "face", "mesh", "levels"}
_SPACING_M = 0.05  # between points along a lane's middle


class PoseBoundsConfig(StrictModel):
    """Allowed places of one object; an axis that is not given is fixed.

    Attributes:
        x_m: Lowest and highest x of the object's origin [m].
        y_m: The same of y [m].
        yaw_rad: Lowest and highest heading [rad].
        scale: Lowest and highest scale; not for a panel or cube, whose size is the size of their boards.
    """

    x_m: Interval | None = None
    y_m: Interval | None = None
    yaw_rad: tuple[Angle, Angle] | None = None
    scale: Interval | None = None

    @field_validator("x_m", "y_m", "yaw_rad", "scale")
    @classmethod
    def _ordered(cls, interval: Interval | None) -> Interval | None:
        if interval is not None and interval[0] > interval[1]:
            raise ValueError(f"expected the lower bound first, got {list(interval)}")
        return interval


class FaceConfig(StrictModel):
    """The textured square of a panel or cube in a learned scene of a user's own, and what shows it in the room.

    Attributes:
        size_m: Edge of the square at scale 1 [m].
        resolution: Colours along each edge; None: the value for all panels (object.panel_resolution).
        rgb: Colour of faces that are not attacked; None: the value for all panels (object.panel_rgb).
        target: Calibration of the board that shows it: motion-capture subject and corners.
        subject: Motion-capture subject of the board if there is no target; None: no board shows it.
        display: File of 'advnerf car calibrate display' or 'printer': the colours of the monitor, or of the print, are part of the search.
        display_cos: Mean cosine, over a drive, of the angle at which the camera sees the monitor.
        marker_m: Side of the markers in the white border of its print, which is then part of the scene, about [m]; None: no border.
    """

    size_m: Length = 2.0
    resolution: Annotated[int, Field(ge=2, le=128)] | None = None
    rgb: tuple[Unit, Unit, Unit] | None = None
    target: NamedFile | None = None
    subject: Annotated[str, Field(min_length=1)] | None = None
    display: NamedFile | None = None
    display_cos: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    marker_m: Length | None = None

    @model_validator(mode="after")
    def _of_a_print(self) -> FaceConfig:
        if self.marker_m is not None and not (self.target is None and self.subject is None):
            raise ValueError(
                "expected no marker_m, which is of a print, with the target or subject of a board that shows the texture, got both"
            )
        return self


class MeshConfig(StrictModel):
    """An object that is attacked as a mesh, not as voxels, in a learned scene of a user's own.

    Attributes:
        texels: Texels along the object's longest side.
        up: Axis of the file that points up; None: y for glTF, z for others.
        unit: Unit of the file; formats other than glTF need it, or height_m.
        height_m: Height to which the object is scaled [m]; for a ball its diameter.
        rgb: Colour of a ball.
    """

    texels: Annotated[int, Field(ge=2, le=512)] = 32
    up: Literal["z", "y"] | None = None
    unit: Literal["mm", "cm", "m", "in"] | None = None
    height_m: Length | None = None
    rgb: tuple[Unit, Unit, Unit] = (0.75, 0.1, 0.08)


class PlacedObject(StrictModel):
    """Place of an object of the attack, which is not part of the captured world.

    Attributes:
        name: Unique name.
        kind: Kind of object: small_car, hydrant, panel, or a user's file, see `object_kinds`; in a scene of a user's own also cube and ball.
        x_m: Middle of its foot [m].
        y_m: Middle of its foot [m].
        z_m: Height of the ground under it [m]: the kerb's on a pavement.
        yaw_rad: Heading of its front [rad]; a panel shows its texture there.
        scale: Size relative to the object as built.
        bounds: Bounds for a search of places; None: the ones of the section space, about the object's place.
        pitch_rad: Downward tilt of its front [rad]; this and the following keys only for a learned scene of a user's own.
        roll_rad: Tilt to its right [rad].
        face: Square of a panel or cube, and the board that shows it.
        mesh: Settings for an object that is attacked as a mesh, not as voxels.
        levels: Number of summed grids, coarse to fine, that give the colours of an object file; 0: one value per voxel.
    """

    name: ObjectName
    kind: ObjectKind
    x_m: float
    y_m: float
    z_m: float = 0.0
    yaw_rad: Angle = 0.0
    scale: float = Field(default=1.0, gt=0.0, le=10.0)
    bounds: PoseBoundsConfig | None = None
    pitch_rad: Angle = 0.0
    roll_rad: Angle = 0.0
    face: FaceConfig | None = None
    mesh: MeshConfig | None = None
    levels: Annotated[int, Field(ge=0, le=32)] = 0

    @model_validator(mode="after")
    def _consistent(self) -> PlacedObject:
        flat, found = self.kind in FLAT, name_of(self.kind)
        if self.face is not None and not flat:
            raise ValueError(f"expected no face, which a panel or cube has, got one of {found}")
        if self.face is not None and self.face.marker_m is not None and self.kind != PANEL:
            raise ValueError(
                f"expected marker_m of a panel, which can be printed with a border, got that of a {found}"
            )
        if self.mesh is not None and (flat or self.kind.endswith(OBJECT_SUFFIX)):
            raise ValueError(f"expected no mesh of {found}, which is made of voxels, got one")
        if self.levels and not self.kind.endswith(OBJECT_SUFFIX):
            raise ValueError(
                f"expected levels of an object file (*{OBJECT_SUFFIX}) only, got those of {found}"
            )
        if self.mesh is None and self.kind.endswith(UNITLESS_SUFFIXES):
            raise ValueError(
                f"expected the section mesh, with a unit or height_m, of {found}, or a mesh whose format knows its unit "
                f"({', '.join(MESH_SUFFIXES)})"
            )
        if self.bounds is not None and self.bounds.scale is not None and flat:
            raise ValueError(f"expected no bounds of the scale of a {found}, which is as large as its board")
        return self

    @property
    def is_of_own_scenes(self) -> bool:
        """Whether the object is possible only in a learned scene of a user's own."""
        short = self.model_dump(exclude_defaults=True)
        return self.kind in (CUBE, BALL) or not short.keys().isdisjoint(_OF_OWN_SCENES)

    @property
    def place(self) -> dict[str, Any]:
        """Name, kind and place as JSON data, and all other values that differ from their defaults."""
        short = self.model_dump(mode="json", exclude_defaults=True)
        return self.model_dump(mode="json", include=_PLACE) | short

    @property
    def footprint_m(self) -> tuple[float, float]:
        """Length and width [m] of the ground that it covers."""
        if self.face is not None:
            length = self.face.size_m if self.kind == CUBE else MADE_HERE_M[PANEL][0]
            return self.scale * length, self.scale * self.face.size_m
        mesh = self.mesh or MeshConfig()
        length, width, _ = extent_m(self.kind, mesh.up, mesh.height_m, mesh.unit)
        return self.scale * length, self.scale * width

    @property
    def side_m(self) -> float:
        """Width [m]; for a panel also its height."""
        return self.footprint_m[1]

    @property
    def T_world_from_face(self) -> Array:
        """Pose ``[4, 4]`` of a panel's face: its middle, x out of it, z up."""
        turned, half_m = self.T_world_from_object, 0.5 * self.side_m
        turned[:3, 3] += turned[:3, 2] * half_m
        return turned

    @property
    def T_world_from_object(self) -> Array:
        """Pose ``[4, 4]`` of its foot, x to its front, z up; the scale is not part of it."""
        turned = rotation_z(self.yaw_rad)
        if self.pitch_rad or self.roll_rad:
            turned = turned @ rotation_y(self.pitch_rad) @ rotation_x(self.roll_rad)
        return make_transform(turned, [self.x_m, self.y_m, self.z_m])

    def corners_m(self) -> list[tuple[float, float]]:
        """The four corners [m] of the ground it covers."""
        length, width = (0.5 * size for size in self.footprint_m)
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
        ends = [(a * length, b * width) for a, b in signs]
        return [(self.x_m + c * u - s * v, self.y_m + s * u + c * v) for u, v in ends]


class Stands(StrictModel):
    """A rule for the place of an object: a spot beside a path where it fits and is visible; see `nodes.experiment.show.placing`.

    Attributes:
        path: The path; None for the experiment's first.
        side: Side of the path; outside: of the turn that the path makes on the way to it, and none where that is straight.
        choose: The first such spot along the path, or the one at which it covers most of a drive's pictures: pixels times time.
        seen_s: Time for which a drive along the path sees nearly all of it, unhidden and from the front [s].
        least_px: Smallest height in the policy's picture during that time [px]. A solid object is taken for an upright square of its width.
        within_half_lanes: Largest distance from the path. The far side of a junction is 12 and more away.
    """

    path: str | None = None
    side: Literal["right", "left", "either", "outside"] = "either"
    choose: Literal["first", "largest_view"] = "first"
    seen_s: float = Field(default=2.0, gt=0.0)
    least_px: float = Field(default=8.0, gt=0.0)
    within_half_lanes: float = Field(default=6.0, gt=1.0, le=20.0)


class RuledObject(StrictModel):
    """An object that a rule places while the world is photographed.

    Attributes:
        name: Unique name.
        kind: Kind of object; see `PlacedObject`.
        z_m: Height of the ground under it [m].
        scale: Size relative to the object as built.
        stands: The rule.
    """

    name: ObjectName
    kind: ObjectKind
    z_m: float = 0.0
    scale: float = Field(default=1.0, gt=0.0, le=10.0)
    stands: Stands

    @field_validator("kind")
    @classmethod
    def _is_built(cls, kind: str) -> str:
        if kind in (CUBE, BALL):
            raise ValueError(f"expected no {kind} by a rule, which only a learned scene of your own has")
        return kind

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
            0.5 * np.array(thing.footprint_m),
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
