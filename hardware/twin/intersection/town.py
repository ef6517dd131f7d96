"""What stands where beside the roads: houses, trees, lamps and signs, and which of it a car runs into."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hardware.twin.config import Colour
from hardware.twin.intersection.config import IntersectionConfig
from hardware.twin.vehicle import Footprint

Side = Literal["north", "south", "east", "west"]
Style = Literal["house", "shop", "flats", "hall"]


@dataclass(frozen=True)
class House:
    """A house with upright walls over a rectangle.

    Attributes:
        x: Its extent along x [m].
        y: Its extent along y [m].
        eaves_m: Height of the walls [m].
        ridge_m: Height of the roof above the walls [m]; 0 for a flat roof.
        wall_rgb: Colour of the walls, 0..1.
        roof: Name of the roof's swatch.
        front: Side with the door.
        style: What its front looks like.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    eaves_m: float
    ridge_m: float
    wall_rgb: Colour
    roof: str
    front: Side
    style: Style = "house"


@dataclass(frozen=True)
class Tree:
    """A tree: where its trunk stands [m], its height [m], the radius of its crown [m] and the crown's swatch."""

    x_m: float
    y_m: float
    height_m: float
    radius_m: float
    leaves: str


_CREAM, _BRICK, _BLUE, _SAGE = (0.86, 0.80, 0.66), (0.66, 0.36, 0.28), (0.55, 0.66, 0.76), (0.62, 0.70, 0.56)
_WHITE, _OCHRE, _ROSE, _GREY = (0.88, 0.88, 0.85), (0.84, 0.64, 0.34), (0.80, 0.58, 0.54), (0.60, 0.61, 0.63)
_PLUM, _TEAL = (0.52, 0.38, 0.46), (0.40, 0.58, 0.58)

HOUSES: tuple[House, ...] = (
    # North of the main road, west to east.
    House((-57.0, -47.5), (8.8, 17.0), 6.4, 2.8, _OCHRE, "tiles_brown", "south"),
    House((-46.0, -36.0), (8.8, 17.0), 9.2, 0.0, _GREY, "flat", "south", "flats"),
    House((-34.5, -26.0), (9.4, 18.0), 6.2, 3.0, _SAGE, "tiles_red", "south"),
    House((-24.5, -14.5), (8.8, 18.0), 8.8, 2.6, _BRICK, "slate", "south", "flats"),
    House((-13.0, -5.0), (9.6, 18.0), 6.0, 3.2, _WHITE, "tiles_red", "south"),
    House((-3.4, 7.2), (8.8, 18.0), 9.6, 0.0, _TEAL, "flat", "south", "shop"),
    House((8.8, 17.0), (9.4, 18.0), 6.3, 3.0, _CREAM, "tiles_brown", "south"),
    House((18.5, 29.0), (8.8, 17.5), 9.4, 2.4, _ROSE, "slate", "south", "flats"),
    House((30.5, 39.0), (9.2, 17.5), 6.4, 3.0, _BLUE, "tiles_red", "south"),
    House((40.5, 57.0), (9.0, 18.0), 8.0, 3.4, _PLUM, "slate", "south", "hall"),
    # South-west: the corner house, then along the main road, then along the side road.
    House((-21.0, -10.4), (-20.5, -10.2), 9.2, 0.0, _OCHRE, "flat", "north", "shop"),
    House((-32.5, -23.0), (-18.5, -9.2), 6.2, 3.0, _WHITE, "slate", "north"),
    House((-44.5, -34.5), (-18.5, -8.8), 9.0, 2.6, _BRICK, "tiles_brown", "north", "flats"),
    House((-57.0, -46.5), (-18.0, -9.0), 6.4, 3.0, _SAGE, "tiles_red", "north"),
    House((-18.0, -9.0), (-32.0, -22.5), 6.4, 3.0, _BLUE, "tiles_brown", "east"),
    House((-18.0, -8.8), (-44.5, -33.5), 9.2, 0.0, _CREAM, "flat", "east", "flats"),
    House((-18.0, -9.0), (-57.0, -46.0), 6.4, 3.0, _ROSE, "slate", "east"),
    # South-east: a small park on the corner, then the same.
    House((22.5, 33.0), (-18.5, -9.0), 8.8, 2.6, _CREAM, "tiles_red", "north", "flats"),
    House((34.5, 44.0), (-18.5, -9.2), 6.2, 3.0, _TEAL, "tiles_brown", "north"),
    House((45.5, 57.0), (-18.5, -8.8), 9.2, 0.0, _BRICK, "flat", "north", "shop"),
    House((9.2, 18.5), (-34.5, -24.0), 6.4, 3.2, _ROSE, "tiles_red", "west"),
    House((8.8, 18.0), (-45.5, -36.0), 9.4, 0.0, _GREY, "flat", "west", "flats"),
    House((9.2, 18.0), (-57.0, -47.0), 6.4, 3.0, _OCHRE, "slate", "west"),
)
TREES: tuple[Tree, ...] = (
    Tree(-41.0, 7.3, 6.2, 1.9, "leaves_dark"), Tree(-29.0, 7.4, 5.6, 1.7, "leaves_light"), Tree(-14.0, 7.6, 6.6, 1.9, "leaves_olive"),
    Tree(8.0, 7.4, 6.0, 1.8, "leaves_light"), Tree(23.0, 7.2, 6.6, 1.9, "leaves_dark"), Tree(39.5, 7.4, 5.8, 1.8, "leaves_olive"),
    Tree(-26.0, -7.4, 6.0, 1.8, "leaves_light"), Tree(-39.0, -7.3, 6.4, 1.8, "leaves_olive"), Tree(-7.4, -21.3, 5.4, 1.6, "leaves_olive"),
    Tree(-7.4, -33.0, 6.0, 1.7, "leaves_dark"), Tree(-7.4, -45.2, 5.6, 1.7, "leaves_light"), Tree(7.5, -35.2, 6.0, 1.7, "leaves_light"),
    Tree(7.6, -46.2, 6.2, 1.8, "leaves_dark"), Tree(40.0, -7.4, 6.0, 1.8, "leaves_dark"),
    # The park.
    Tree(12.0, -9.6, 6.4, 2.1, "leaves_dark"), Tree(17.5, -9.4, 5.6, 1.9, "leaves_light"), Tree(10.4, -14.4, 5.4, 1.8, "leaves_olive"),
    Tree(15.0, -15.6, 7.2, 2.5, "leaves_light"), Tree(19.8, -14.0, 6.6, 2.1, "leaves_dark"), Tree(10.4, -20.2, 6.0, 1.9, "leaves_dark"),
)  # fmt: skip
LAMPS: tuple[tuple[float, float], ...] = (
    (-33.0, 4.4), (-9.0, 4.4), (15.0, 4.4), (38.0, 4.4), (-21.0, -4.4), (-45.0, -4.4), (27.0, -4.4), (50.0, -4.4),
    (4.4, -21.0), (-4.4, -28.0), (4.4, -38.0), (-4.4, -48.0),
)  # fmt: skip
# Where the stop sign of the side road stands; it faces south.
STOP_SIGN = (4.5, -14.2)


def obstacles(config: IntersectionConfig) -> list[Footprint]:
    """What the car cannot drive through: houses, trunks and posts. The attacked objects are not part of the world."""
    found = []
    for house in HOUSES:
        (x0, x1), (y0, y1) = house.x, house.y
        found.append(Footprint(0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * (x1 - x0), 0.5 * (y1 - y0)))
    found += [Footprint(tree.x_m, tree.y_m, 0.2, 0.2) for tree in TREES]
    found += [Footprint(x, y, 0.1, 0.1) for x, y in (*LAMPS, STOP_SIGN)]
    return found
