"""The room's furniture as plain solids: drawn, casting shadows, and obstacles to the car."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from hardware.worlds.footprints import Footprint
from hardware.worlds.lab.config import Colour, LabConfig, PanelConfig
from hardware.worlds.lab.vehicle import TwinVehicle

Point = tuple[float, float, float]

WOOD: Colour = (0.58, 0.42, 0.27)
DARK_WOOD: Colour = (0.36, 0.25, 0.18)
WHITE: Colour = (0.86, 0.85, 0.82)
GREY: Colour = (0.45, 0.47, 0.50)
LEAF: Colour = (0.28, 0.42, 0.16)
TERRACOTTA: Colour = (0.70, 0.36, 0.24)


@dataclass(frozen=True)
class Solid:
    """One convex solid.

    Attributes:
        kind: Shape; cylinders stand upright.
        centre_m: Centre in the world [m].
        half_m: Half extents along the solid's own axes [m].
        rgb: Colour, 0..1.
        yaw_rad: Turn about the vertical axis [rad].
        name: Name of the piece of furniture.
    """

    kind: Literal["box", "cylinder", "ellipsoid"]
    centre_m: Point
    half_m: Point
    rgb: Colour
    yaw_rad: float = 0.0
    name: str = ""

    @property
    def footprint(self) -> Footprint:
        """The solid's bounding rectangle on the floor."""
        return Footprint(
            self.centre_m[0], self.centre_m[1], self.half_m[0], self.half_m[1], self.yaw_rad, self.name
        )


class _LocalSolids:
    """Collects solids given in a local frame: x right, y back (towards the wall), z up, origin on the floor."""

    def __init__(self, x_m: float, y_m: float, yaw_rad: float) -> None:
        self._x, self._y, self._yaw = x_m, y_m, yaw_rad
        self.solids: list[Solid] = []

    def add(
        self, kind: Literal["box", "cylinder", "ellipsoid"], centre: Point, half: Point, rgb: Colour
    ) -> None:
        c, s = math.cos(self._yaw), math.sin(self._yaw)
        x, y = self._x + c * centre[0] - s * centre[1], self._y + s * centre[0] + c * centre[1]
        self.solids.append(Solid(kind, (x, y, centre[2]), half, rgb, self._yaw))

    def box(
        self, x: float, y: float, bottom: float, width: float, depth: float, height: float, rgb: Colour
    ) -> None:
        self.add("box", (x, y, bottom + 0.5 * height), (0.5 * width, 0.5 * depth, 0.5 * height), rgb)

    def cylinder(self, x: float, y: float, bottom: float, radius: float, height: float, rgb: Colour) -> None:
        self.add("cylinder", (x, y, bottom + 0.5 * height), (radius, radius, 0.5 * height), rgb)


def furnish(config: LabConfig) -> list[Solid]:
    """All solids of the room: along the walls, on the middle island, and the stands of board and monitor."""
    half = 0.5 * config.room.side_m
    places = [
        ("bookshelf", _bookshelf(-2.35, -half, math.pi)),
        ("cabinet", _cabinet(0.05, -half, math.pi)),
        ("plant", _plant(1.75, -half + 0.42, 0.34)),
        ("crates", _crates(half - 0.45, -half + 0.45)),
        ("sofa", _sofa(half, 1.05, -0.5 * math.pi)),
        ("lamp", _lamp(half - 0.35, 2.75)),
        ("plant", _plant(half - 0.5, half - 0.5, 0.5)),
        ("desk", _desk(-1.35, half, 0.0)),
        ("radiator", _radiator(0.55, half, 0.0)),
        ("wardrobe", _wardrobe(-half, 1.75, 0.5 * math.pi)),
        ("armchair", _armchair(-half + 0.55, -0.55, 0.5 * math.pi)),
        ("bin", _bin(-half + 0.4, -1.95)),
        ("cartons", _cartons(-half + 0.5, -half + 0.5)),
        ("cartons", _cartons(-half + 0.45, half - 0.5)),
        ("island", _island()),
        ("board", _panel(config.board, WOOD)),
        ("monitor", _panel(config.monitor, (0.12, 0.12, 0.13))),
    ]
    return [replace(solid, name=name) for name, place in places for solid in place.solids]


def _panel(panel: PanelConfig, stand_rgb: Colour) -> _LocalSolids:
    """The box behind a panel's face, a pole and a foot."""
    place = _LocalSolids(panel.x_m, panel.y_m, panel.yaw_rad - 0.5 * math.pi)  # local -y is behind the face
    back, half_t = -panel.thickness_m, 0.5 * panel.thickness_m
    face_gap = 0.0005  # the face itself is drawn as its own surface, just in front of the box
    place.add(
        "box",
        (0.0, -half_t - 0.5 * face_gap, panel.z_m),
        (0.5 * panel.width_m, half_t - 0.5 * face_gap, 0.5 * panel.height_m),
        panel.rgb,
    )
    top = panel.z_m
    place.box(0.0, back - 0.025, 0.0, 0.08, 0.05, top, stand_rgb)
    place.box(0.0, back - 0.04, 0.0, 0.6 * panel.width_m, 0.22, 0.025, stand_rgb)
    return place


def obstacles(config: LabConfig) -> list[Footprint]:
    """Footprints of everything that the car's body can hit."""
    reach = config.car.body_height_m + 0.02
    return [s.footprint for s in furnish(config) if s.centre_m[2] - s.half_m[2] < reach]


def walls(config: LabConfig) -> list[Footprint]:
    """The four walls, as rectangles outside the room that are as thick as the room is wide."""
    side, half = config.room.side_m, 0.5 * config.room.side_m
    ways = ((1, 0), (0, 1), (-1, 0), (0, -1))
    return [Footprint(side * x, side * y, half, half + side, math.atan2(y, x), "wall") for x, y in ways]


def vehicle_in_room(config: LabConfig) -> TwinVehicle:
    """The lab's car at its nominal start, with the lab's walls and furniture as obstacles; renders nothing."""
    return TwinVehicle(config.car, obstacles(config), 0.5 * config.room.side_m, config.start_pose)


def _bookshelf(x: float, y: float, yaw: float) -> _LocalSolids:
    p = _LocalSolids(x, y, yaw)
    depth, width, height = 0.32, 1.5, 1.8
    p.box(0.0, -0.025, 0.0, width, 0.04, height, DARK_WOOD)
    for side in (-1, 1):
        p.box(side * (0.5 * width - 0.02), -0.5 * depth - 0.005, 0.0, 0.04, depth, height, DARK_WOOD)
    for level in range(5):
        p.box(0.0, -0.5 * depth - 0.005, level * 0.44, width, depth, 0.04, DARK_WOOD)
    # Wide blocks of books in distinct colours instead of single spines: texture, not noise.
    rows: list[list[tuple[float, float, float, Colour]]] = [
        [(-0.45, 0.50, 0.30, (0.66, 0.20, 0.18)), (0.20, 0.55, 0.26, (0.20, 0.32, 0.52))],
        [
            (-0.50, 0.36, 0.28, (0.85, 0.66, 0.25)),
            (0.05, 0.44, 0.33, (0.34, 0.47, 0.40)),
            (0.5, 0.3, 0.22, WHITE),
        ],
        [(-0.30, 0.70, 0.25, (0.50, 0.36, 0.55)), (0.45, 0.40, 0.32, (0.82, 0.45, 0.22))],
        [(-0.52, 0.30, 0.32, (0.24, 0.48, 0.58)), (0.25, 0.60, 0.24, (0.72, 0.62, 0.50))],
    ]
    for level, row in enumerate(rows):
        for centre, length, tall, rgb in row:
            p.box(centre, -0.18, level * 0.44 + 0.04, length, 0.2, tall, rgb)
    return p


def _cabinet(x: float, y: float, yaw: float) -> _LocalSolids:
    p = _LocalSolids(x, y, yaw)
    p.box(0.0, -0.24, 0.08, 1.5, 0.44, 0.62, (0.72, 0.70, 0.64))
    p.box(0.0, -0.24, 0.0, 1.4, 0.36, 0.08, DARK_WOOD)
    for side, rgb in ((-0.375, (0.44, 0.56, 0.60)), (0.375, (0.80, 0.60, 0.42))):
        p.box(side, -0.465, 0.14, 0.66, 0.012, 0.50, rgb)
    p.box(-0.45, -0.22, 0.70, 0.45, 0.25, 0.28, (0.30, 0.30, 0.34))
    p.cylinder(0.30, -0.22, 0.70, 0.11, 0.32, (0.18, 0.42, 0.62))
    p.cylinder(0.58, -0.22, 0.70, 0.07, 0.18, (0.82, 0.74, 0.30))
    return p


def _plant(x: float, y: float, size: float) -> _LocalSolids:
    p = _LocalSolids(x, y, 0.3)
    p.cylinder(0.0, 0.0, 0.0, 0.5 * size, 0.8 * size, TERRACOTTA)
    crown: list[tuple[float, float, float, float, Colour]] = [
        (0.0, 0.0, 1.9, 0.62, LEAF),
        (0.3, 0.12, 1.45, 0.42, (0.36, 0.50, 0.20)),
        (-0.28, -0.2, 1.6, 0.45, (0.22, 0.36, 0.17)),
    ]
    for dx, dy, z, radius, rgb in crown:
        r = radius * size
        p.add("ellipsoid", (dx * size, dy * size, z * size), (r, r, 1.2 * r), rgb)
    return p


def _crates(x: float, y: float) -> _LocalSolids:
    p = _LocalSolids(x, y, 0.12)
    p.box(0.0, 0.0, 0.0, 0.62, 0.56, 0.44, (0.20, 0.36, 0.56))
    p.box(-0.02, 0.03, 0.44, 0.50, 0.46, 0.38, (0.80, 0.55, 0.20))
    p.box(0.05, 0.02, 0.82, 0.34, 0.34, 0.26, (0.64, 0.24, 0.24))
    return p


def _sofa(x: float, y: float, yaw: float) -> _LocalSolids:
    p = _LocalSolids(x, y, yaw)
    body, cushion = (0.30, 0.36, 0.50), (0.42, 0.49, 0.64)
    p.box(0.0, -0.42, 0.06, 1.9, 0.80, 0.30, body)
    p.box(0.0, -0.13, 0.36, 1.9, 0.22, 0.46, body)
    for side in (-1, 1):
        p.box(side * 0.86, -0.42, 0.36, 0.18, 0.80, 0.22, body)
        p.box(side * 0.38, -0.48, 0.36, 0.72, 0.58, 0.10, cushion)
    p.box(-0.55, -0.32, 0.46, 0.40, 0.14, 0.34, (0.86, 0.62, 0.24))
    p.box(0.0, -0.42, 0.0, 1.7, 0.66, 0.06, DARK_WOOD)
    return p


def _lamp(x: float, y: float) -> _LocalSolids:
    p = _LocalSolids(x, y, 0.0)
    p.cylinder(0.0, 0.0, 0.0, 0.17, 0.04, GREY)
    p.cylinder(0.0, 0.0, 0.04, 0.025, 1.36, GREY)
    p.cylinder(0.0, 0.0, 1.40, 0.21, 0.30, (0.95, 0.88, 0.66))
    return p


def _desk(x: float, y: float, yaw: float) -> _LocalSolids:
    p = _LocalSolids(x, y, yaw)
    p.box(0.0, -0.36, 0.70, 1.6, 0.70, 0.05, WOOD)
    p.box(0.56, -0.36, 0.0, 0.42, 0.62, 0.70, (0.62, 0.62, 0.60))
    p.box(-0.75, -0.36, 0.0, 0.06, 0.62, 0.70, WOOD)
    p.box(-0.15, -0.20, 0.84, 0.62, 0.05, 0.38, (0.16, 0.17, 0.20))
    p.box(-0.15, -0.18, 0.75, 0.12, 0.12, 0.10, GREY)
    p.box(0.55, -0.35, 0.75, 0.26, 0.34, 0.16, (0.76, 0.30, 0.26))
    # A chair pushed in.
    p.box(-0.2, -0.62, 0.40, 0.46, 0.44, 0.07, (0.20, 0.44, 0.46))
    p.box(-0.2, -0.84, 0.47, 0.46, 0.05, 0.45, (0.20, 0.44, 0.46))
    p.cylinder(-0.2, -0.62, 0.05, 0.04, 0.35, GREY)
    p.cylinder(-0.2, -0.62, 0.0, 0.22, 0.05, GREY)
    return p


def _radiator(x: float, y: float, yaw: float) -> _LocalSolids:
    p = _LocalSolids(x, y, yaw)
    p.box(0.0, -0.07, 0.12, 1.1, 0.10, 0.58, WHITE)
    p.box(0.0, -0.05, 0.0, 0.9, 0.05, 0.12, GREY)
    return p


def _wardrobe(x: float, y: float, yaw: float) -> _LocalSolids:
    p = _LocalSolids(x, y, yaw)
    p.box(0.0, -0.29, 0.0, 1.3, 0.56, 1.95, (0.66, 0.55, 0.42))
    for side, rgb in ((-0.32, (0.74, 0.64, 0.50)), (0.32, (0.70, 0.60, 0.47))):
        p.box(side, -0.575, 0.10, 0.58, 0.014, 1.75, rgb)
    p.box(-0.06, -0.59, 0.95, 0.03, 0.02, 0.22, GREY)
    p.box(0.06, -0.59, 0.95, 0.03, 0.02, 0.22, GREY)
    return p


def _armchair(x: float, y: float, yaw: float) -> _LocalSolids:
    p = _LocalSolids(x, y, yaw)
    body = (0.66, 0.30, 0.26)
    p.box(0.0, 0.0, 0.05, 0.80, 0.74, 0.33, body)
    p.box(0.0, 0.28, 0.38, 0.80, 0.20, 0.46, body)
    for side in (-1, 1):
        p.box(side * 0.34, -0.04, 0.38, 0.13, 0.62, 0.18, (0.58, 0.25, 0.22))
    p.box(0.0, -0.08, 0.38, 0.54, 0.50, 0.08, (0.80, 0.46, 0.36))
    return p


def _bin(x: float, y: float) -> _LocalSolids:
    p = _LocalSolids(x, y, 0.0)
    p.cylinder(0.0, 0.0, 0.0, 0.20, 0.50, (0.34, 0.36, 0.40))
    p.cylinder(0.0, 0.0, 0.50, 0.21, 0.04, (0.85, 0.72, 0.22))
    return p


def _cartons(x: float, y: float) -> _LocalSolids:
    p = _LocalSolids(x, y, -0.2 if y < 0 else 0.25)
    p.box(0.0, 0.0, 0.0, 0.60, 0.50, 0.40 if y < 0 else 0.62, (0.71, 0.56, 0.38))
    p.box(0.0, 0.0, 0.40 if y < 0 else 0.62, 0.10, 0.50, 0.004, (0.82, 0.74, 0.60))
    p.box(
        0.06,
        -0.03,
        0.404 if y < 0 else 0.624,
        0.40,
        0.36,
        0.26,
        (0.60, 0.46, 0.30) if y < 0 else (0.46, 0.56, 0.36),
    )
    return p


def _island() -> _LocalSolids:
    """Low furniture within 1 m of the middle, which must not hide one side of the track from the other."""
    p = _LocalSolids(0.0, 0.0, 0.0)
    p.cylinder(0.12, 0.22, 0.0, 0.30, 0.05, DARK_WOOD)
    p.cylinder(0.12, 0.22, 0.05, 0.06, 0.36, DARK_WOOD)
    p.cylinder(0.12, 0.22, 0.41, 0.52, 0.05, (0.78, 0.68, 0.52))
    p.box(0.22, 0.30, 0.46, 0.26, 0.20, 0.12, (0.28, 0.42, 0.62))
    p.cylinder(-0.10, 0.10, 0.46, 0.08, 0.20, (0.84, 0.80, 0.74))
    p.add("ellipsoid", (-0.60, -0.52, 0.29), (0.29, 0.29, 0.29), (0.80, 0.36, 0.20))
    p.box(0.56, -0.60, 0.0, 0.46, 0.40, 0.36, (0.52, 0.30, 0.50))
    p.box(0.50, -0.62, 0.36, 0.24, 0.24, 0.20, (0.88, 0.76, 0.32))
    p.cylinder(-0.68, 0.62, 0.0, 0.22, 0.42, (0.30, 0.54, 0.60))
    p.cylinder(0.76, 0.74, 0.0, 0.15, 0.26, WHITE)
    p.add("ellipsoid", (0.76, 0.74, 0.44), (0.2, 0.2, 0.24), (0.32, 0.46, 0.18))
    return p
