"""Layout of the town: houses, trees, hedges, lamps and a sign, and the obstacles among them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hardware.worlds.footprints import Footprint
from hardware.worlds.junction.config import IntersectionConfig
from hardware.worlds.lab.config import Colour

Side = Literal["north", "south", "east", "west"]
Style = Literal["house", "shop", "flats", "hall"]


@dataclass(frozen=True)
class House:
    """A house with upright walls over a rectangle.

    Attributes:
        x: Extent along x [m].
        y: Extent along y [m].
        eaves_m: Height of the walls [m].
        ridge_m: Height of the roof above the walls [m]; 0 for a flat roof.
        wall: Name of the walls' colour.
        roof: Name of the roof's swatch.
        front: Side with the door.
        style: Style of the front.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    eaves_m: float
    ridge_m: float
    wall: str
    roof: str
    front: Side
    style: Style = "house"


@dataclass(frozen=True)
class Tree:
    """A tree: position of its trunk [m], its height [m], the radius of its crown [m] and the crown's swatch."""

    x_m: float
    y_m: float
    height_m: float
    radius_m: float
    leaves: str


WALLS: dict[str, Colour] = {
    "cream": (0.86, 0.80, 0.66), "brick": (0.66, 0.38, 0.30), "sky_blue": (0.55, 0.66, 0.76), "sage": (0.62, 0.70, 0.56),
    "white_wall": (0.88, 0.88, 0.85), "ochre": (0.84, 0.64, 0.34), "rose": (0.80, 0.58, 0.54), "grey": (0.60, 0.61, 0.63),
    "plum": (0.52, 0.38, 0.46), "teal": (0.40, 0.58, 0.58),
}  # fmt: skip
HOUSES: tuple[House, ...] = (
    # North of the main road, west to east.
    House((-57.0, -47.5), (8.8, 17.0), 6.4, 2.8, "ochre", "tiles_brown", "south"),
    House((-46.0, -36.0), (8.8, 17.0), 9.2, 0.0, "grey", "flat", "south", "flats"),
    House((-34.5, -26.0), (9.4, 18.0), 6.2, 3.0, "sage", "tiles_red", "south"),
    House((-24.5, -14.5), (8.8, 18.0), 8.8, 2.6, "brick", "slate", "south", "flats"),
    House((-13.0, -5.0), (9.6, 18.0), 6.0, 3.2, "white_wall", "tiles_red", "south"),
    House((-3.4, 7.2), (8.8, 18.0), 9.6, 0.0, "teal", "flat", "south", "shop"),
    House((8.8, 17.0), (9.4, 18.0), 6.3, 3.0, "cream", "tiles_brown", "south"),
    House((18.5, 29.0), (8.8, 17.5), 9.4, 2.4, "rose", "slate", "south", "flats"),
    House((30.5, 39.0), (9.2, 17.5), 6.4, 3.0, "sky_blue", "tiles_red", "south"),
    House((40.5, 57.0), (9.0, 18.0), 8.0, 3.4, "plum", "slate", "south", "hall"),
    # South-west: the corner house, then along the main road, then along the side road.
    House((-21.0, -10.4), (-20.5, -10.2), 9.2, 0.0, "ochre", "flat", "north", "shop"),
    House((-32.5, -23.0), (-18.5, -9.2), 6.2, 3.0, "white_wall", "slate", "north"),
    House((-44.5, -34.5), (-18.5, -8.8), 9.0, 2.6, "brick", "tiles_brown", "north", "flats"),
    House((-57.0, -46.5), (-18.0, -9.0), 6.4, 3.0, "sage", "tiles_red", "north"),
    House((-18.0, -9.0), (-32.0, -22.5), 6.4, 3.0, "sky_blue", "tiles_brown", "east"),
    House((-18.0, -8.8), (-44.5, -33.5), 9.2, 0.0, "cream", "flat", "east", "flats"),
    House((-18.0, -9.0), (-57.0, -46.0), 6.4, 3.0, "rose", "slate", "east"),
    # South-east: a small park on the corner, then the same.
    House((22.5, 33.0), (-18.5, -9.0), 8.8, 2.6, "cream", "tiles_red", "north", "flats"),
    House((34.5, 44.0), (-18.5, -9.2), 6.2, 3.0, "teal", "tiles_brown", "north"),
    House((45.5, 57.0), (-18.5, -8.8), 9.2, 0.0, "brick", "flat", "north", "shop"),
    House((9.2, 18.5), (-34.5, -24.0), 6.4, 3.2, "rose", "tiles_red", "west"),
    House((8.8, 18.0), (-45.5, -36.0), 9.4, 0.0, "grey", "flat", "west", "flats"),
    House((9.2, 18.0), (-57.0, -47.0), 6.4, 3.0, "ochre", "slate", "west"),
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
# Low hedges along front gardens: x0, x1, y0, y1 [m].
HEDGES: tuple[tuple[float, float, float, float], ...] = (
    (-34.0, -31.2, 6.7, 7.3), (-29.2, -26.4, 6.7, 7.3), (-12.6, -10.0, 6.7, 7.3), (-8.2, -5.4, 6.7, 7.3), (9.6, 12.0, 6.7, 7.3),
    (13.8, 16.8, 6.7, 7.3), (31.0, 33.8, 6.7, 7.3), (35.8, 38.6, 6.7, 7.3), (-32.0, -28.8, -7.3, -6.7), (-26.6, -23.4, -7.3, -6.7),
    (-7.3, -6.7, -26.0, -23.0), (-7.3, -6.7, -31.6, -28.4), (6.7, 7.3, -28.2, -24.4), (6.7, 7.3, -34.0, -30.4),
    (22.8, 26.6, -7.3, -6.7), (28.8, 32.6, -7.3, -6.7),
)  # fmt: skip
# A post box, a bench, two bins: x0, x1, y0, y1 [m], height [m], swatch.
BOXES: tuple[tuple[float, float, float, float, float, str], ...] = (
    (-17.3, -16.7, 5.6, 6.1, 1.3, "yellow"), (12.8, 14.6, -11.6, -11.1, 0.5, "wood"), (-1.2, -0.7, 5.8, 6.3, 1.0, "blue"),
    (-5.6, -5.1, -17.6, -17.1, 1.0, "blue"), (24.0, 24.6, 5.7, 6.2, 1.1, "sign_red"),
)  # fmt: skip
# Position of the side road's stop sign, which faces south.
STOP_SIGN = (4.5, -14.2)


def obstacles(config: IntersectionConfig) -> list[Footprint]:
    """Everything solid: houses, trunks, hedges, boxes and posts. The attacked objects are not part of the world."""
    found = []
    for house in HOUSES:
        (x0, x1), (y0, y1) = house.x, house.y
        found.append(_upright(x0, x1, y0, y1, "house"))
    found += [Footprint(tree.x_m, tree.y_m, 0.2, 0.2, name="tree") for tree in TREES]
    found += [_upright(*hedge, "hedge") for hedge in HEDGES]
    found += [_upright(*box[:4], "street furniture") for box in BOXES]
    found += [Footprint(x, y, 0.1, 0.1, name="lamp post") for x, y in LAMPS]
    return [*found, Footprint(*STOP_SIGN, 0.1, 0.1, name="stop sign")]


def _upright(x0: float, x1: float, y0: float, y1: float, name: str) -> Footprint:
    return Footprint(0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * (x1 - x0), 0.5 * (y1 - y0), name=name)
